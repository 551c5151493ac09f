"""Self-attention over the positions of a feature map: the variants that the paper tried and rejected.

Both know where a place is from sines and cosines of its row and column, so that they take maps of any size.
"""

from __future__ import annotations

from probe2road.errors import needs_extra

with needs_extra("train", feature="the segmentation network in torch"):
    import torch
    from torch import Tensor, nn
    from torch.nn import functional

__all__ = ["AttentionCentre", "SpatialAttention"]

_HEADS = 4
_LAYERS = 4  # of the transformer in the centre
_LONGEST_WAVE = 256.0  # places; longer than any map


class SpatialAttention(nn.Module):
    """Multi-head self-attention that replaces a 3x3 convolution.

    Notes
    -----
    After the bottleneck transformer (Srinivas et al., CVPR 2021), with positions added to queries and keys instead of
    a table of relative positions, which would fix the size of the map.

    Examples
    --------
    >>> SpatialAttention(16)(torch.zeros(2, 16, 5, 7)).shape
    torch.Size([2, 16, 5, 7])
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query_key = nn.Conv2d(channels, 2 * channels, 1, bias=False)
        self.value = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:  # (n, c, h, w)
        """Return a map of the same shape."""
        n, c, h, w = x.shape
        query, key = self.query_key(x + positions(x)).chunk(2, dim=1)
        query, key, value = (
            t.reshape(n, _HEADS, c // _HEADS, h * w).transpose(2, 3) for t in (query, key, self.value(x))
        )
        y = functional.scaled_dot_product_attention(query, key, value)  # (n, heads, h w, c / heads)
        return y.transpose(2, 3).reshape(n, c, h, w)


class AttentionCentre(nn.Module):
    """A vision transformer that replaces the dilated convolutions; every position of the centre map is a token.

    Notes
    -----
    After TransUNet (Chen et al., 2021).

    Examples
    --------
    >>> AttentionCentre(16)(torch.zeros(2, 16, 5, 7)).shape
    torch.Size([2, 16, 5, 7])
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(channels, _HEADS, 2 * channels, dropout=0.0, batch_first=True, norm_first=True)
            for _ in range(_LAYERS)
        )

    def forward(self, x: Tensor) -> Tensor:  # (n, c, h, w)
        """Return a map of the same shape."""
        n, c, h, w = x.shape
        tokens = (x + positions(x)).flatten(2).transpose(1, 2)  # (n, h w, c)
        for layer in self.layers:
            tokens = layer(tokens)
        return tokens.transpose(1, 2).reshape(n, c, h, w)


def positions(x: Tensor) -> Tensor:
    """Return sines and cosines of row and column for a map ``(n, c, h, w)``: shape ``(1, c, h, w)``; c of fours."""
    _, c, h, w = x.shape
    waves = torch.arange(c // 4, device=x.device, dtype=x.dtype) / (c // 4)
    frequency = (2 * torch.pi / _LONGEST_WAVE) * _LONGEST_WAVE ** (1 - waves)  # radians per place
    row, column = (torch.arange(size, device=x.device, dtype=x.dtype)[None, :] * frequency[:, None] for size in (h, w))
    parts = [wave(row)[:, :, None].expand(-1, -1, w) for wave in (torch.sin, torch.cos)]
    parts += [wave(column)[:, None, :].expand(-1, h, -1) for wave in (torch.sin, torch.cos)]
    return torch.cat(parts)[None]
