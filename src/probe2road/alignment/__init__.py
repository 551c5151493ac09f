"""Fleet alignment: noisy drives moved to where they agree."""
