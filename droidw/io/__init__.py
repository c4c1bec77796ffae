"""Files in and out: trajectories, calibrations, pictures and videos."""
