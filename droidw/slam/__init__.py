"""The SLAM core: motion filter, frontend, backend, filler, and the system that drives them."""
