"""The built-in plugins, registered through the entry-point group `droidw` like anyone's."""
