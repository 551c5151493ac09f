"""DeepMG (Ruan et al., AAAI 2020): trace features, a network with two decoders, links, and refinement by matching."""
