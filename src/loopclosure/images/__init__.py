"""Pixels in: image files, folders, videos, and what a network wants to see of them.

Images are uint8 (h, w, 3), RGB, everywhere outside a network.
"""

from loopclosure.images.ahead import read_ahead
from loopclosure.images.decode import Image, check_image, read_image
from loopclosure.images.preprocess import Preprocessing
from loopclosure.images.sequence import ImageSequence, frames_of

__all__ = ["Image", "ImageSequence", "Preprocessing", "check_image", "frames_of", "read_ahead", "read_image"]
