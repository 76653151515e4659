"""Training: data, losses, the loop, checkpoints and logs. Imported only by who trains."""
