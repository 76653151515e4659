"""GeoMoE and its parts: architecture, blocks, inputs, inference, weights on disk."""
