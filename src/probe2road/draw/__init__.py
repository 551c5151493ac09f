"""Graphs over traces for the eye: pictures, the stages of a run, the HTML page."""
