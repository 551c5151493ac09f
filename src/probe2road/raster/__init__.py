"""The pixel plane: grids, and traces, points and lines drawn into them."""
