"""The configuration files that come with droidw: base, presets, datasets and ablations."""
