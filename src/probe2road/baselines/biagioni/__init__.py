"""Biagioni and Eriksson, "Map inference in the face of noise and disparity", SIGSPATIAL 2012, start to end."""
