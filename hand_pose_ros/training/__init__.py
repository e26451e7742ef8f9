"""Training: recipes, data stream, augmentation, losses and the loop."""
