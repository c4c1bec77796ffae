"""What bundle adjustment is asked to solve, and the weights of its residuals."""
