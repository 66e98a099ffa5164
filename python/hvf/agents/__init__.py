"""What acts: plans with and without subgoals, and the random floor."""
