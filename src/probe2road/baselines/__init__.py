"""The methods that the paper compares itself with, as functions from fleet data to a road graph."""
