from __future__ import annotations

import numpy as np

from probe2road.alignment.lines import condense, match_lines
from probe2road.alignment.options import AlignOptions


def two_drives(off: float, turn: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of two drives on two lines, the second drive off and turned: along, left, drive."""
    along = np.tile(np.linspace(0.0, 9.0, 40), 2)
    left = np.where(np.arange(80) % 2 == 0, -1.8, 1.8) + 0.0
    second = np.arange(80) >= 40
    return along, left + second * (off + turn * along), second.astype(np.int64)


def test_residuals_of_two_drives_lie_on_either_side() -> None:
    along, left, drive = two_drives(0.3)
    zeros = np.zeros(80, np.int64)
    matches = match_lines(zeros, along, left, zeros.astype(np.int8), drive, AlignOptions(), gate=1.0)
    assert np.allclose(matches.residual, np.where(drive == 0, -0.15, 0.15), atol=0.03)


def test_a_line_that_one_drive_saw_attracts_nobody() -> None:
    along, left, drive = two_drives(0.0)
    zeros = np.zeros(80, np.int64)
    matches = match_lines(zeros, along, left, zeros.astype(np.int8), drive * 0, AlignOptions(), gate=1.0)
    assert len(matches.point) == 0


def test_kinds_and_floors_do_not_share_lines() -> None:
    along, left, drive = two_drives(0.0)
    zeros = np.zeros(80, np.int64)
    for floor, kind in ((drive, zeros), (zeros, drive)):
        matches = match_lines(floor, along, left, kind.astype(np.int8), drive, AlignOptions(), gate=1.0)
        assert len(matches.point) == 0


def test_condensed_factor_undoes_a_shift_and_a_turn() -> None:
    along, left, drive = two_drives(0.2, turn=0.02)
    zeros = np.zeros(80, np.int64)
    matches = match_lines(zeros, along, left, zeros.astype(np.int8), drive, AlignOptions(), gate=1.0)
    sigma, straight = np.full(len(matches.point), 0.2), np.zeros(len(matches.point))
    body = np.column_stack([along, left])[matches.point]
    factor = condense(matches, drive[matches.point], zeros[matches.point], body, straight, sigma, gate=2.0)
    first, second = factor.correction
    # Both are moved to the middle: half of the difference each.
    assert abs(second[1] - first[1] + 0.2) < 0.02
    assert abs(second[2] - first[2] + 0.02) < 0.004
    assert np.allclose(factor.information, factor.information.transpose(0, 2, 1))
    assert (np.linalg.eigvalsh(factor.information) > 0).all()
