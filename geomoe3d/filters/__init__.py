"""From correspondences to weights: the network, its parts, and classical filters."""
