"""Files of episodes: one reader a format."""
