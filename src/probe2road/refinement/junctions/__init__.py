"""Junctions as traces drive them: false ones taken apart, forks where ramps leave, carriageways side by side."""
