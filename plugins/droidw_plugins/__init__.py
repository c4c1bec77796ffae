"""The parts that come with droidw, registered as a stranger's package would register its own.

Each subpackage is one plugin of the entry-point group `droidw` and offers one kind of part.
"""
