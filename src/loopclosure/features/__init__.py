"""Images to features: feature maps of networks, and what is drawn from an image without one."""
