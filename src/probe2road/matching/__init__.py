"""What `probe2road.matching.match` is made of: states, observations, two hidden Markov models, tables."""
