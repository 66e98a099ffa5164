"""A verb that is killed loses a unit of work at most, and ends in the same result."""

from __future__ import annotations

from pathlib import Path

import pytest

import kill_and_resume


@pytest.mark.slow
@pytest.mark.parametrize("verb", kill_and_resume.JOBS)
def test_killed_at_a_random_moment_it_goes_on_to_the_same_result(verb: str, tmp_path: Path) -> None:
    for line in kill_and_resume.check(verb, 3, 0, tmp_path):
        print(line)
