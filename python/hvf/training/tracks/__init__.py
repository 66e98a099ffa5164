"""What object models see in recorded episodes, kept beside the data."""
