"""What the losses cost: skeletons and distances of CP-loss, its weights by threads, and the losses themselves.

Run with ``python benchmarks/bench_losses.py``; ``--device cuda`` computes losses and network there. The yardstick is a
training step of the network that ``--network`` names. Only times of one run are comparable with each other.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from bench_vectorize import best_of, road_mask
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import skeletonize as zhang_of_skimage

from probe2road.segmentation.connectivity import connectivity_weights, dilate, distances, wrong_skeletons
from probe2road.segmentation.dlinknet import DLinkNet, find_architecture
from probe2road.segmentation.losses import LossOptions, loss_function
from probe2road.vectorize.skeleton import skeletonize

SIZES = (512, 1000)  # px
BATCHES = (2, 4)  # images
ROADS = 8  # in an image
REPEATS = 7


def image_pair(size: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Draw a reference one pixel wide, and a prediction some pixels wide with holes, shifts and ghosts."""
    roads = road_mask(size, roads=ROADS, width=5.0)
    reference = skeletonize(roads)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((size, size)), 8) * 8 * np.sqrt(4 * np.pi)
    prediction = (roads & (noise > -1.2)) | (noise > 2.6)
    return prediction, reference


def parts(size: int) -> None:
    """Print what one image costs, step by step, beside the usual libraries."""
    prediction, reference = image_pair(size)
    wrong = wrong_skeletons(prediction, reference)
    missed = wrong.missed
    print(f"\nimage of {size} x {size} px: {prediction.mean():.1%} predicted, {reference.sum()} px of reference,")
    print(f"  {wrong.missed.sum()} px missed, {wrong.ghost.sum()} px of ghosts; milliseconds")
    full = np.ones((size, size), bool)
    square = np.ones((2, 2), bool)
    rows: list[tuple[str, Callable[[], object], Callable[[], object] | None]] = [
        ("skeleton of the prediction", lambda: skeletonize(prediction, method="zhang_suen"),
         lambda: zhang_of_skimage(prediction)),  # type: ignore[no-untyped-call]
        ("skeleton of the reference", lambda: skeletonize(reference, method="zhang_suen"), None),
        ("skeleton of a full image", lambda: skeletonize(full, method="zhang_suen"), None),
        ("dilation", lambda: dilate(reference, "2x2"), lambda: ndimage.binary_dilation(reference, square)),
        ("distance transform", lambda: distances(missed), lambda: ndimage.distance_transform_edt(~missed)),
    ]  # fmt: skip
    for name, ours, theirs in rows:
        time = best_of(REPEATS, ours)
        ratio = "" if theirs is None else f"scikit-image or scipy: {best_of(REPEATS, theirs) / time:.1f} times as long"
        print(f"  {name:<28} {time * 1e3:7.2f} {ratio}")


def losses(size: int, images: int, device: str) -> Iterator[tuple[str, float]]:
    """Yield name and seconds of the weights and of both losses with their gradients, for a batch."""
    prediction, reference = (np.repeat(mask[None], images, axis=0) for mask in image_pair(size))
    with ThreadPoolExecutor() as pool:
        yield "weights, one thread", best_of(REPEATS, lambda: connectivity_weights(prediction, reference))
        yield "weights, pool", best_of(REPEATS, lambda: connectivity_weights(prediction, reference, pool=pool))
    target = torch.from_numpy(reference).float().to(device)
    logits = torch.from_numpy(prediction).float().to(device).mul(6).sub(3).requires_grad_()
    for kind in ("bce_dice", "cp"):
        loss = loss_function(LossOptions(kind=kind, warm_up=0))
        yield f"{kind} with gradient", best_of(REPEATS, lambda loss=loss: finish(loss(logits, target, 0)))  # type: ignore[misc]


def training_step(size: int, images: int, device: str, network: str) -> Callable[[], None]:
    """Return a forward and a backward pass in bf16, with the cheapest of losses."""
    layers = DLinkNet(find_architecture(network)).to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    counts = torch.rand(images, 3, size, size, device=device).to(memory_format=torch.channels_last)

    def step() -> None:
        with torch.autocast(device, torch.bfloat16):
            logits = layers(counts)
        finish(logits.float().mean())

    return step


def finish(loss: torch.Tensor) -> None:
    """Run the backward pass and wait for the device."""
    loss.backward()  # type: ignore[no-untyped-call]
    if loss.is_cuda:
        torch.cuda.synchronize()


def main(device: str, network: str) -> None:
    """Print parts, then batches."""
    print(f"torch {torch.__version__} on {device}, {torch.get_num_threads()} threads")
    for size in SIZES:
        parts(size)
    for size in SIZES:
        for images in BATCHES:
            step = best_of(2, training_step(size, images, device, network))
            print(f"\nbatch of {images} images of {size} x {size} px; milliseconds, share of a step of {network}")
            print(f"  {'network, both passes':<28} {step * 1e3:7.1f}")
            for name, seconds in losses(size, images, device):
                print(f"  {name:<28} {seconds * 1e3:7.1f} {seconds / step:7.1%}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--network", default="compact", help="a name of ARCHITECTURES")
    arguments = parser.parse_args()
    main(arguments.device, arguments.network)
