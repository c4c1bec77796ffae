"""One protocol per kind of plugin: shapes, frames, units and duties."""
