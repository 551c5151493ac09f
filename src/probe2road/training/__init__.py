"""Training the segmentation network: scenes, samples, configuration, the loop, and what decides its checkpoint."""
