"""The configuration: its schema, how files are merged, and how names become plugins."""
