"""The keypoint object model: one coloured box that moves before a still scene."""
