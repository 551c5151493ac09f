"""Fleet data: what every stage may assume about drives."""
