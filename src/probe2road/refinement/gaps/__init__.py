"""Gaps filled: dead ends and interrupted roads linked to what they were cut off from."""
