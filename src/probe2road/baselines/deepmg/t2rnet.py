"""T2RNet, the network of DeepMG, and its loss (METHOD 3.2).

Legend of tensor shapes: B tiles of a batch, H rows and W columns of a tile (multiples of 16), w the width.
"""

from __future__ import annotations

from probe2road.baselines.deepmg.features import COARSE_CELLS, PLANES
from probe2road.errors import needs_extra

with needs_extra("train", feature="the network of DeepMG"):
    import torch
    from torch import Tensor, nn

__all__ = ["REGION_SHARE", "T2RNet", "soft_dice_loss", "t2rnet_loss"]

REGION_SHARE = 0.2  # of the loss; the lambda of the paper

_TRANSITION_BITS = 2 * COARSE_CELLS**2
_HIDDEN, _EMBEDDED = 64, 8  # channels of the transition network
_STAGES = (1, 2, 4, 8)  # widths of the encoder's stages, in w
_CENTRE = 16  # the same of its centre
_SPREAD = 0.02  # standard deviation of the weights at the start


class T2RNet(nn.Module):
    """A U-Net with one encoder and two decoders, for the region of roads and for their centrelines.

    Parameters
    ----------
    width
        Channels of the first stage; the published network has 64.

    Examples
    --------
    >>> network = T2RNet(width=4).eval()
    >>> outputs = network(torch.zeros(1, len(PLANES), 32, 32), torch.zeros(1, 128, 32, 32))
    >>> [tuple(output.shape) for output in outputs]
    [(1, 32, 32), (1, 32, 32)]
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        stages = [factor * width for factor in _STAGES]
        self.transition = nn.Sequential(
            nn.Conv2d(_TRANSITION_BITS, _HIDDEN, 1), nn.ReLU(), nn.Conv2d(_HIDDEN, _EMBEDDED, 1), nn.ReLU()
        )
        inputs = [len(PLANES) + _EMBEDDED, *stages]
        self.encoder = nn.ModuleList(_block(i, o) for i, o in zip(inputs, stages, strict=False))
        self.centre = _block(stages[-1], _CENTRE * width)
        downwards = stages[::-1]
        below = [_CENTRE * width, *downwards]
        self.region_up = nn.ModuleList(_upsample(i, o) for i, o in zip(below, downwards, strict=False))
        self.line_up = nn.ModuleList(_upsample(i, o) for i, o in zip(below, downwards, strict=False))
        self.region = nn.ModuleList(_block(2 * channels, channels) for channels in downwards)
        self.line = nn.ModuleList(_block(3 * channels, channels) for channels in downwards)
        self.region_head = nn.Conv2d(width, 1, 3, padding=1)
        self.line_head = nn.Conv2d(width, 1, 3, padding=1)
        self.apply(_start)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a quarter faster on a CPU

    def forward(self, planes: Tensor, transitions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the probabilities of a centreline and of the region of a road, shape (B, H, W) each.

        Parameters
        ----------
        planes
            Shape (B, 11, H, W).
        transitions
            Shape (B, 128, H, W), zeros and ones.
        """
        x = torch.cat([planes, self.transition(transitions)], dim=1)  # (B, 19, H, W)
        skips = []
        for stage in self.encoder:
            x = stage(x)
            skips.append(x)  # (B, w, H, W), (B, 2w, H/2, W/2), (B, 4w, H/4, W/4), (B, 8w, H/8, W/8)
            x = nn.functional.max_pool2d(x, 2)
        region = line = self.centre(x)  # (B, 16w, H/16, W/16)
        for level, skip in enumerate(reversed(skips)):
            raised = self.region_up[level](region)
            region = self.region[level](torch.cat([skip, raised], dim=1))
            # The centreline decoder sees what the region decoder raised to this level.
            line = self.line[level](torch.cat([skip, self.line_up[level](line), raised], dim=1))
        return torch.sigmoid(self.line_head(line))[:, 0], torch.sigmoid(self.region_head(region))[:, 0]


def soft_dice_loss(probability: Tensor, label: Tensor) -> Tensor:
    """Return one minus the Dice coefficient of a batch, pooled over all its pixels and smoothed by 1.

    Examples
    --------
    >>> float(soft_dice_loss(torch.tensor([0.5, 0.5]), torch.tensor([1.0, 0.0])))
    0.333...
    """
    overlap = (probability * label).sum()
    return 1.0 - (2.0 * overlap + 1.0) / (probability.sum() + label.sum() + 1.0)


def t2rnet_loss(outputs: tuple[Tensor, Tensor], line_label: Tensor, region_label: Tensor) -> Tensor:
    """Return the sum of both decoders' losses: 0.8 of the centreline's and 0.2 of the region's."""
    line, region = outputs
    return (1.0 - REGION_SHARE) * soft_dice_loss(line, line_label) + REGION_SHARE * soft_dice_loss(region, region_label)


def _block(channels_in: int, channels_out: int) -> nn.Sequential:
    """Return two 3 x 3 convolutions, each with batch normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, padding=1), nn.BatchNorm2d(channels_out), nn.ReLU(inplace=True),
        nn.Conv2d(channels_out, channels_out, 3, padding=1), nn.BatchNorm2d(channels_out), nn.ReLU(inplace=True),
    )  # fmt: skip


def _upsample(channels_in: int, channels_out: int) -> nn.Sequential:
    """Return a transposed convolution with ReLU that doubles rows and columns."""
    return nn.Sequential(
        nn.ConvTranspose2d(channels_in, channels_out, 4, stride=2, padding=1, bias=False), nn.ReLU(inplace=True)
    )


def _start(module: nn.Module) -> None:
    """Draw the weights of convolutions from a normal distribution, and set biases to 0."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, std=_SPREAD)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
