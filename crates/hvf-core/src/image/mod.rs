//! Costs between images.
