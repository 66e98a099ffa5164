"""Random interaction: collected, kept in HDF5, and sampled for training."""
