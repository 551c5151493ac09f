"""The open benchmark: fleet data on real road networks with known truth, made from fixed seeds, and its splits."""

from __future__ import annotations
