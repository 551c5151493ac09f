"""Mask in, road graph out: lines of one pixel, chains of pixels, edges."""
