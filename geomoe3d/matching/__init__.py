"""Features of two clouds to putative correspondences."""
