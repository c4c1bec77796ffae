"""For tests of plugins: synthetic scenes with exact truth and a conformance suite per kind."""
