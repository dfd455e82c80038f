"""Many local vectors to one descriptor for an image."""
