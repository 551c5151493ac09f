"""The losses for training the segmentation network.

Strategy
--------
Both losses are a mean cross entropy plus a soft Dice term, pooled over the batch. CP-loss weights them pixel by
pixel: the nearer a pixel lies to a place where the thresholded prediction and the reference disagree about a
skeleton, the more it counts. Those weights (`probe2road.segmentation.connectivity`) need the prediction of the
very same step, so that nothing can be computed ahead without changing the loss. They are computed on the CPU by a
pool of threads, two tasks an image, outside automatic differentiation: the gradient flows through the
probabilities in the weights' formulas, not through skeletons and distances.

Cross entropy is written with the logarithm of the sigmoid instead of that of a clamped probability. It is finite for
every finite output of the network, and a pixel that is confidently wrong keeps its gradient.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

from probe2road.bounds import AtLeast, NotNegative, Positive, Probability
from probe2road.errors import InputError, needs_extra
from probe2road.options import checked
from probe2road.segmentation.connectivity import Buffer, connectivity_weights
from probe2road.vectorize.skeleton import Method

with needs_extra("train", feature="training the segmentation network"):
    import torch
    from torch import Tensor
    from torch.nn.functional import logsigmoid, max_pool2d, pad

__all__ = ["Loss", "LossOptions", "bce_dice", "cp_loss", "gaps", "loss_function"]

Loss = Callable[[Tensor, Tensor, int], Tensor]
"""Logits, target and the number of the training step (from 0) to the loss, a scalar."""

_XI, _ETA = 0.25, 0.5  # weights in the Dice term (METHOD 2.1); up to 0.5 the gradient on road is never positive
_LIMIT = 1e4  # logits; far beyond what networks put out, and small enough to stay finite when squared and summed


@dataclass(frozen=True)
@checked
class LossOptions:
    """The loss that training minimises."""

    kind: Literal["bce_dice", "cp"] = "cp"  # bce_dice, or cp: the connectivity-preserving loss
    warm_up: NotNegative[int] = 2000  # steps of BCE + Dice before CP-loss; 30 epochs of the paper (METHOD 0.1 row 9)
    sigma: Positive[float] = 100.0  # px, reach of a wrong skeleton (METHOD 0.1 row 11)
    buffer: Buffer = "2x2"  # how far a skeleton may deviate: 2x2 (the paper's, one-sided) or 3x3
    thinning: Method = "zhang_suen"  # thinning for CP-loss: zhang_suen (as in its source) or guo_hall
    threshold: Probability = 0.5  # probability from which a pixel is in the mask that is thinned
    ce_weight: NotNegative[float] = 1.0  # weight of the mean cross entropy beside the Dice term, in both losses
    gap_weight: Annotated[float, AtLeast(1)] = 1.0  # how often background between close lines counts; BCE + Dice only
    gap_width: Positive[int] = 6  # px, largest width of the background between close lines
    smooth: NotNegative[float] = 1.0  # pixels added above and below the fraction of the Dice term


def bce_dice(
    logits: Tensor,
    target: Tensor,
    *,
    ce_weight: float = 1.0,
    smooth: float = 1.0,
    gap_weight: float = 1.0,
    gap_width: int = 6,
) -> Tensor:
    """Return mean binary cross entropy plus soft Dice loss, pooled over all pixels of the batch.

    A batch without road is fine unless ``smooth`` is 0; then its Dice term is 1.

    Parameters
    ----------
    logits
        What the network puts out, of any shape and floating type; computed in float32.
    target
        1 on road and 0 elsewhere, same shape.
    ce_weight
        Weight of the cross entropy; the Dice term has weight 1.
    smooth
        Added to numerator and denominator of the Dice coefficient, pixels.
    gap_weight, gap_width
        How often a pixel of `gaps` counts in the cross entropy, so that close lines stay two.

    Returns
    -------
    Tensor
        Scalar of float32.

    Raises
    ------
    InputError
        If the shapes differ.

    Notes
    -----
    METHOD 1.3, with a smoothing term. The weight between close lines follows the border weights of Ronneberger,
    Fischer and Brox, "U-Net", MICCAI 2015.

    Examples
    --------
    >>> right = torch.tensor([20.0, -20.0])
    >>> target = torch.tensor([1.0, 0.0])
    >>> round(float(bce_dice(right, target)), 3), round(float(bce_dice(-right, target)), 3)
    (0.0, 20.667)
    """
    x, g = _in_float32(logits, target)
    p = torch.sigmoid(x)
    entropy = -(g * logsigmoid(x) + (1 - g) * logsigmoid(-x))
    if gap_weight != 1.0:
        entropy = entropy * (1 + (gap_weight - 1) * gaps(g, gap_width))
    return ce_weight * entropy.mean() + _dice(2 * (p * g).sum(), p.sum() + g.sum(), smooth)


def gaps(target: Tensor, width: int) -> Tensor:
    """Mark the background between lines that are close to each other, by closing with a square.

    Parameters
    ----------
    target
        1 on road and 0 elsewhere, shape ``(..., rows, cols)``.
    width
        Largest width of such background along rows or columns, pixels.

    Returns
    -------
    Tensor
        1 between close lines and 0 elsewhere, same shape and type.

    Examples
    --------
    >>> [gaps(torch.tensor([[1.0, 0, 0, 1, 0, 0, 0, 1]]), width)[0].int().tolist() for width in (2, 3)]
    [[0, 1, 1, 0, 0, 0, 0, 0], [0, 1, 1, 0, 1, 1, 1, 0]]
    """
    wide = pad(target.reshape(-1, *target.shape[-2:]), [width] * 4)
    dilated = max_pool2d(wide, width + 1, stride=1)
    closed = -max_pool2d(-dilated, width + 1, stride=1)
    return closed.view_as(target) * (1 - target)


def cp_loss(
    logits: Tensor, target: Tensor, weights_g: Tensor, weights: Tensor, *, ce_weight: float = 1.0, smooth: float = 1.0
) -> Tensor:
    """Return the connectivity-preserving loss, pooled over all pixels of the batch.

    It is no measure of quality: a perfect prediction does not reach 0, and the weights change from step to step
    (METHOD 2.4). Without wrong skeletons it is a focal loss plus a weighted Dice loss.

    Parameters
    ----------
    logits
        What the network puts out, of any shape and floating type; computed in float32.
    target
        1 on road and 0 elsewhere, same shape.
    weights_g, weights
        Proximity to missed reference skeleton and to any wrong skeleton, in [0, 1], same shape; they are constants
        to the gradient.
    ce_weight
        Weight of the mean cross entropy; the Dice term has weight 1.
    smooth
        Added to numerator and denominator of the Dice coefficient, pixels.

    Returns
    -------
    Tensor
        Scalar of float32.

    Raises
    ------
    InputError
        If the shapes differ.

    Notes
    -----
    Xu, Sun, Wang and Liu, "CP-loss: Connectivity-preserving loss for road curb detection in autonomous driving with
    aerial images", IROS 2021 (METHOD 2.1), with the mean of the cross entropy instead of its sum (METHOD 2.4).

    Examples
    --------
    A pixel of road with probability one half, on a missed piece of skeleton and far from any:

    >>> x, g = torch.tensor([0.0]), torch.tensor([1.0])
    >>> [round(float(cp_loss(x, g, w * g, w * g)), 3) for w in (1, 0)]
    [1.858, 0.582]
    """
    x, g, wg, w = _in_float32(logits, target, weights_g.detach(), weights.detach())
    p = torch.sigmoid(x)
    u, v = (1 + wg - p) ** 2, (w + p) ** 2
    entropy = -(u * g * logsigmoid(x) + v * (1 - g) * logsigmoid(-x)).mean()
    counted = _XI * (1 + w - _ETA * p) * p
    return ce_weight * entropy + _dice(2 * (counted * g).sum(), (counted**2).sum() + (g**2).sum(), smooth)


def loss_function(options: LossOptions | None = None) -> Loss:
    """Return the loss as a function of logits, target and step number, for a training loop.

    Parameters
    ----------
    options
        CP-loss after the default warm-up where None.

    Returns
    -------
    Loss
        Takes logits and target of shape ``(images, 1, rows, cols)`` or ``(images, rows, cols)`` and the step, from
        0. It holds a pool of threads that starts with the first use of CP-loss and ends when nobody holds the loss
        any more.

    Examples
    --------
    >>> loss = loss_function(LossOptions(warm_up=10))
    >>> target = torch.zeros(2, 1, 8, 8)
    >>> target[:, :, 4] = 1
    >>> [round(float(loss(20 * target - 10, target, step)), 3) for step in (9, 10)]
    [0.0, 0.71]
    """
    options = options or LossOptions()
    pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="cp-loss")  # it starts threads when they are needed
    warm_up = partial(
        bce_dice,
        ce_weight=options.ce_weight,
        smooth=options.smooth,
        gap_weight=options.gap_weight,
        gap_width=options.gap_width,
    )
    connecting = partial(cp_loss, ce_weight=options.ce_weight, smooth=options.smooth)

    def loss(logits: Tensor, target: Tensor, step: int) -> Tensor:
        if options.kind == "bce_dice" or step < options.warm_up:
            return warm_up(logits, target)
        return connecting(logits, target, *_weights(logits, target, options, pool))

    return loss


def _weights(logits: Tensor, target: Tensor, options: LossOptions, pool: Executor) -> tuple[Tensor, Tensor]:
    """Return the weights of CP-loss in the shape of the logits and on their device."""
    prediction = torch.sigmoid(logits.detach().float()) > options.threshold
    missed, wrong = (
        torch.from_numpy(weight).to(logits.device).view(logits.shape)
        for weight in connectivity_weights(
            prediction.flatten(0, -3).cpu().numpy(),
            (target > 0).flatten(0, -3).cpu().numpy(),
            sigma=options.sigma,
            buffer=options.buffer,
            thinning=options.thinning,
            pool=pool,
        )
    )
    return missed, wrong


def _in_float32(logits: Tensor, *maps: Tensor) -> list[Tensor]:
    """Return logits, limited in size, and their maps in single precision; all must have the same shape."""
    shapes = [tuple(each.shape) for each in (logits, *maps)]
    if len(set(shapes)) > 1:
        wrong = f"logits have shape {shapes[0]}, target and weights {', '.join(map(str, shapes[1:]))}"
        raise InputError(wrong, where="the loss", fix="give all the shape of the logits")
    return [logits.float().clamp(-_LIMIT, _LIMIT), *(each.float() for each in maps)]


def _dice(shared: Tensor, total: Tensor, smooth: float) -> Tensor:
    """Return the Dice loss; 1 for empty masks without smoothing."""
    return 1 - (shared + smooth) / (total + smooth).clamp(min=torch.finfo(torch.float32).tiny)
