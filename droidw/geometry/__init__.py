"""Geometry: rigid motions, projection between frames, interpolation, alignment, the camera.

Conventions (docs/design.md): `T_cw` is world to camera, stored as [tx ty tz qx qy qz qw]; tangent
vectors put translation first; updates multiply from the left; disparity is inverse depth; pixel
centres are integers. The modules are imported by name, so that importing the package is free.
"""
