"""The paper's tables on open data: methods times data sets, scored, with intervals, pictures and what they cost."""
