"""D-LinkNet: a residual encoder, a centre of dilated convolutions, and a light decoder with additive skips.

Letters of the shape comments: n images, c channels, h and w pixels; F0 to F3 channels of the four encoder stages,
at strides 4, 8, 16 and 32.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from probe2road.bounds import AtLeast, Positive
from probe2road.errors import OptionError, needs_extra
from probe2road.options import checked

with needs_extra("train", feature="the segmentation network in torch"):
    import torch
    from torch import Tensor, nn
    from torch.nn import functional

from probe2road.segmentation.attention import AttentionCentre, SpatialAttention

__all__ = ["ARCHITECTURES", "STRIDE", "Architecture", "DLinkNet", "find_architecture"]

STRIDE = 32  # pixels of the input for one pixel of the centre


@dataclass(frozen=True)
@checked
class Architecture:
    """The sizes and variants of a network of the D-LinkNet family."""

    blocks: tuple[Positive[int], Positive[int], Positive[int], Positive[int]] = (3, 4, 6, 3)  # residual blocks a stage
    width: Annotated[int, AtLeast(8)] = 64  # channels of the stem, and of the first stage before expansion
    bottleneck: bool = False  # blocks of ResNet-50 (1x1, 3x3, 1x1 to four times the channels) instead of two 3x3
    dilations: tuple[Positive[int], ...] = (1, 2, 4, 8)  # of the convolutions of the centre
    centre_width: Positive[int] | None = None  # channels of these convolutions; None: those of the encoder
    head_width: Positive[int] = 32  # channels at full resolution
    centre: Literal["dilated", "transformer"] = "dilated"  # convolutions, or self-attention over all places
    attention: bool = False  # whether self-attention replaces the 3x3 convolutions of the last stage

    def __post_init__(self) -> None:
        """Refuse sizes that no network can have."""
        if self.width % 8:
            raise OptionError(f"width is {self.width}", where="Architecture", fix="use a multiple of 8")

    @property
    def features(self) -> tuple[int, int, int, int]:
        """Return the channels F0 to F3 of the encoder stages."""
        first = self.width * (_Bottleneck.expansion if self.bottleneck else 1)
        return first, 2 * first, 4 * first, 8 * first


_FIVE = (1, 2, 4, 8, 16)

# The published networks, the compact one for CPU users, and the variants that the paper tried and rejected.
ARCHITECTURES: Mapping[str, Architecture] = {
    "dlinknet34": Architecture(),
    "dlinknet50": Architecture(bottleneck=True, dilations=_FIVE),
    "dlinknet101": Architecture(blocks=(3, 4, 23, 3), bottleneck=True, dilations=_FIVE),
    "compact": Architecture(width=32, centre_width=128, head_width=16),
    "compact_attention": Architecture(width=32, centre_width=128, head_width=16, attention=True),
    "compact_transformer": Architecture(width=32, head_width=16, centre="transformer"),
}


def find_architecture(name: str) -> Architecture:
    """Return an architecture by name.

    Raises
    ------
    OptionError
        If there is none of that name.

    Examples
    --------
    >>> find_architecture("dlinknet50").features
    (256, 512, 1024, 2048)
    """
    if name not in ARCHITECTURES:
        raise OptionError(f"there is no architecture {name!r}", fix=f"use one of {', '.join(ARCHITECTURES)}")
    return ARCHITECTURES[name]


class DLinkNet(nn.Module):
    """A network from count rasters to centreline logits.

    Parameters
    ----------
    architecture
        One of `ARCHITECTURES`, or any other of the family.
    channels
        Of the input.
    classes
        Of the output.

    Notes
    -----
    METHOD 1.1. The input is ``(n, channels, h, w)``, log10(1 + count), of any size from one pixel: it is padded with
    zeros on all sides to a multiple of 32, and the output ``(n, classes, h, w)`` is cropped back. The output is
    logits. Layers of the encoder have the names that torchvision gives them.

    Examples
    --------
    >>> network = DLinkNet(find_architecture("dlinknet34"))
    >>> sum(parameter.numel() for parameter in network.parameters())
    31096129
    >>> with torch.no_grad():
    ...     network.eval()(torch.zeros(1, 3, 40, 70)).shape
    torch.Size([1, 1, 40, 70])
    """

    def __init__(self, architecture: Architecture, *, channels: int = 3, classes: int = 1) -> None:
        super().__init__()
        f0, f1, f2, f3 = architecture.features
        width = architecture.width
        self.architecture = architecture
        self.channels = channels
        self.conv1 = nn.Conv2d(channels, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.layer1 = _stage(architecture, 0, width, stride=1)
        self.layer2 = _stage(architecture, 1, f0, stride=2)
        self.layer3 = _stage(architecture, 2, f1, stride=2)
        self.layer4 = _stage(architecture, 3, f2, stride=2)
        self.centre: nn.Module
        if architecture.centre == "transformer":
            self.centre = AttentionCentre(f3)
        else:
            self.centre = _DilatedCentre(f3, architecture.centre_width, architecture.dilations)
        self.decoder4 = _Decoder(f3, f2)
        self.decoder3 = _Decoder(f2, f1)
        self.decoder2 = _Decoder(f1, f0)
        self.decoder1 = _Decoder(f0, f0)
        head = architecture.head_width
        self.head = nn.Sequential(
            nn.ConvTranspose2d(f0, head, 4, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(head, head, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(head, classes, 3, padding=1),
        )
        self.apply(_initialise)

    def forward(self, x: Tensor) -> Tensor:  # (n, c, h, w)
        """Return logits ``(n, classes, h, w)``."""
        height, width = x.shape[-2:]
        up, left = (-height % STRIDE) // 2, (-width % STRIDE) // 2
        down, right = -height % STRIDE - up, -width % STRIDE - left
        x = functional.pad(x, (left, right, up, down))
        x = functional.relu(self.bn1(self.conv1(x)))  # (n, width, h/2, w/2)
        x = functional.max_pool2d(x, 3, stride=2, padding=1)
        e1 = self.layer1(x)  # (n, F0, h/4, w/4)
        e2 = self.layer2(e1)  # (n, F1, h/8, w/8)
        e3 = self.layer3(e2)  # (n, F2, h/16, w/16)
        e4 = self.layer4(e3)  # (n, F3, h/32, w/32)
        d4 = self.decoder4(self.centre(e4)) + e3
        d3 = self.decoder3(d4) + e2
        d2 = self.decoder2(d3) + e1
        d1 = self.decoder1(d2)  # (n, F0, h/2, w/2)
        y: Tensor = self.head(d1)  # (n, classes, h, w)
        return y[..., up : up + height, left : left + width]


class _Basic(nn.Module):
    """A residual block of two 3x3 convolutions with a shortcut (ResNet-18 and -34)."""

    expansion = 1

    def __init__(self, before: int, width: int, stride: int, attention: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = SpatialAttention(width) if attention else nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(before, width, stride)

    def forward(self, x: Tensor) -> Tensor:  # (n, before, h, w)
        y = functional.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        return functional.relu(y + self.downsample(x))


class _Bottleneck(nn.Module):
    """A residual block of 1x1, 3x3 and 1x1 convolutions with a shortcut (ResNet-50 and -101)."""

    expansion = 4

    def __init__(self, before: int, width: int, stride: int, attention: bool) -> None:
        super().__init__()
        after = width * self.expansion
        self.conv1 = nn.Conv2d(before, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = (
            nn.Sequential(SpatialAttention(width), nn.AvgPool2d(stride))
            if attention
            else nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        )
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, after, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(after)
        self.downsample = _shortcut(before, after, stride)

    def forward(self, x: Tensor) -> Tensor:  # (n, before, h, w)
        y = functional.relu(self.bn1(self.conv1(x)))
        y = functional.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return functional.relu(y + self.downsample(x))


class _DilatedCentre(nn.Module):
    """A cascade of dilated convolutions; the outputs of all stages are added to the input."""

    def __init__(self, channels: int, width: int | None, dilations: tuple[int, ...]) -> None:
        super().__init__()
        inner = width or channels
        narrow = inner != channels
        self.reduce = nn.Conv2d(channels, inner, 1) if narrow else nn.Identity()
        self.expand = nn.Conv2d(inner, channels, 1) if narrow else nn.Identity()
        self.dilated = nn.ModuleList(nn.Conv2d(inner, inner, 3, padding=d, dilation=d) for d in dilations)

    def forward(self, x: Tensor) -> Tensor:  # (n, F3, h, w)
        y = self.reduce(x)
        total = torch.zeros_like(y)
        for convolution in self.dilated:
            y = functional.relu(convolution(y))
            total = total + y
        summed: Tensor = x + self.expand(total)
        return summed


class _Decoder(nn.Module):
    """A decoder block that doubles the resolution, through a quarter of the channels."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        inner = before // 4
        self.steps = nn.Sequential(
            nn.Conv2d(before, inner, 1),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            nn.ConvTranspose2d(inner, inner, 3, stride=2, padding=1, output_padding=1),
            nn.BatchNorm2d(inner),
            nn.ReLU(),
            nn.Conv2d(inner, after, 1),
            nn.BatchNorm2d(after),
            nn.ReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:  # (n, before, h, w)
        y: Tensor = self.steps(x)  # (n, after, 2h, 2w)
        return y


def _stage(architecture: Architecture, number: int, before: int, *, stride: int) -> nn.Sequential:
    """Build an encoder stage; its first block reduces the resolution."""
    kind = _Bottleneck if architecture.bottleneck else _Basic
    width = architecture.width * 2**number
    attention = architecture.attention and number == 3
    after = width * kind.expansion
    blocks = [kind(before, width, stride, attention)]
    blocks += [kind(after, width, 1, attention) for _ in range(architecture.blocks[number] - 1)]
    return nn.Sequential(*blocks)


def _shortcut(before: int, after: int, stride: int) -> nn.Module:
    """Return the layers that bring the input of a block to the shape of its output."""
    if stride == 1 and before == after:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(before, after, 1, stride=stride, bias=False), nn.BatchNorm2d(after))


def _initialise(module: nn.Module) -> None:
    """Initialise the weights of convolutions by Kaiming's method, and biases with zero."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if module.bias is not None:
            nn.init.zeros_(module.bias)
