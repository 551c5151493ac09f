"""Gentle procedural terrain: the ground on which roads lie where no structure raises them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Terrain"]


@dataclass(frozen=True)
class Terrain:
    """A smooth random surface: a sum of plane waves."""

    wave: NDArray[np.float64]  # (k, 2), rad per m
    phase: NDArray[np.float64]  # (k,), rad
    amplitude: NDArray[np.float64]  # (k,), m
    base: float  # m

    @classmethod
    def from_rng(cls, rng: np.random.Generator, *, relief: float, scale: float, waves: int = 24) -> Terrain:
        """Draw a surface with a standard deviation (m) and wavelengths from ``scale`` (m) to four times that."""
        length = scale * 4.0 ** rng.random(waves)
        angle = rng.uniform(0.0, 2 * np.pi, waves)
        wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        amplitude = length / np.sqrt(np.sum(length**2) / 2.0) * relief
        return cls(wave, rng.uniform(0.0, 2 * np.pi, waves), amplitude, 10.0 + 3.0 * relief)

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the heights at positions (m), shape ``(n, 2)``; the surface never repeats, so any metric CRS works."""
        total = np.full(len(xy), self.base)
        for wave, phase, amplitude in zip(self.wave, self.phase, self.amplitude, strict=True):
            total += amplitude * np.sin(xy @ wave + phase)
        return total
