"""Tables of results, and the paper's experiments as lists of evaluations."""
