"""Reading and writing trajectories, video and weights."""
