"""The open benchmark: data sets on real road networks with known truth, and the paper's tables made on them."""
