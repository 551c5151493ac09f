"""What `probe2road.mapmatch` is made of: states, observations, two hidden Markov models, tables."""
