"""The keyframe store and the graph of edges between keyframes."""
