"""The vision transformer that `dinov2`, `fit3d` and `metric3d` share, and checks of checkpoints."""
