//! The 2D maze: geometry, physics, renderer and episodes.
