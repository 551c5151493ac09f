"""The fleet simulator: road networks to 3-D lanes, traffic and sensors, to fleet data with known truth."""
