"""GeoMoE, its baselines and their parts: architecture, blocks, inputs, inference, weights on disk."""
