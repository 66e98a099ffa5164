"""Files that were made to break whoever opens them; see README.md."""
