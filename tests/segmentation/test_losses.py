import numpy as np
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.options import options_from_table

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from probe2road.segmentation.connectivity import connectivity_weights  # noqa: E402
from probe2road.segmentation.losses import LossOptions, bce_dice, cp_loss, loss_function  # noqa: E402

SURE = 50.0  # a logit whose sigmoid is 1 in float32


def logit(p):
    return float(np.log(p / (1 - p)))


def cross_entropy(p, g, w):
    """Return the entropy term of CP-loss at one pixel."""
    x, g, w = (torch.tensor([float(value)]) for value in (logit(p), g, w))
    return float(cp_loss(x, g, w, w) - cp_loss(x, g, w, w, ce_weight=0))


def beta(p, w):
    """Return the weight in the Dice term, read off a pixel of background beside a road with probability 0.

    There the Dice term is 1 - smooth / ((beta p)^2 + 1 + smooth).
    """
    x, g = torch.tensor([logit(p) if p < 1 else SURE, -SURE]), torch.tensor([0.0, 1.0])
    value = float(cp_loss(x, g, torch.zeros(2), torch.tensor([float(w), 0.0]), ce_weight=0, smooth=1))
    return (1 / (1 - value) - 2) ** 0.5 / p


def crossing(size=48):
    """Return a target with two roads, and logits that miss a piece of one and invent a third."""
    target = torch.zeros(1, 1, size, size)
    target[..., size // 2, :] = target[..., :, size // 3] = 1
    logits = 6 * target - 3
    logits[..., size // 2, 20:30] = -3
    logits[..., 5, 25:45] = 2
    return logits, target


# What METHOD 2.4 and 11 print


def test_cross_entropy_of_single_pixels():
    assert cross_entropy(0.5, 1, 1) == pytest.approx(1.5596, abs=1e-4)
    assert cross_entropy(0.9, 0, 0.37) == pytest.approx(3.7138, abs=1e-4)


@pytest.mark.parametrize(("p", "w", "expected"), [(1, 0, 0.125), (1, 1, 0.375), (0.5, 0, 0.1875)])
def test_weight_of_the_dice_term(p, w, expected):
    assert beta(p, w) == pytest.approx(expected, abs=2e-4)


def test_a_perfect_prediction_does_not_reach_zero():
    target = torch.zeros(20, 20)
    target[7] = 1
    none, everywhere = torch.zeros(20, 20), torch.ones(20, 20)
    logits = (2 * target - 1) * SURE
    assert float(cp_loss(logits, target, none, none, smooth=0)) == pytest.approx(0.7538, abs=1e-4)
    assert float(cp_loss(logits, target, none, none, ce_weight=1e3, smooth=0)) == pytest.approx(0.7538, abs=1e-4)
    assert float(cp_loss(logits, target, none, everywhere, ce_weight=0, smooth=0)) == pytest.approx(0.3425, abs=1e-4)


def test_without_wrong_skeletons_the_entropy_is_focal_loss():
    p = torch.tensor([0.1, 0.5, 0.8, 0.3])
    g = torch.tensor([1.0, 0.0, 1.0, 0.0])
    none = torch.zeros(4)
    focal = -(g * (1 - p) ** 2 * p.log() + (1 - g) * p**2 * (1 - p).log()).mean()
    x = torch.logit(p)
    found = cp_loss(x, g, none, none) - cp_loss(x, g, none, none, ce_weight=0)
    assert float(found) == pytest.approx(float(focal), rel=1e-5)


@pytest.mark.parametrize("w", [0.0, 0.3, 1.0])
def test_gradient_of_the_entropy_on_certain_road_is_minus_w_squared(w):
    """METHOD 2.4 says so of the gradient by p; it is taken near p = 1, where dp/dx = p (1 - p) is not 0 yet."""
    p = 0.999
    x = torch.tensor([logit(p)], requires_grad=True)
    g, weight = torch.ones(1), torch.tensor([w])
    (cp_loss(x, g, weight, weight) - cp_loss(x, g, weight, weight, ce_weight=0)).backward()
    assert float(x.grad) / (p * (1 - p)) == pytest.approx(-(w**2), abs=1e-2)


# Gradients


def test_gradient_is_never_positive_on_road_and_never_negative_beside_it():
    rng = np.random.default_rng(0)
    for _ in range(50):
        g = torch.tensor(rng.random(40) < rng.random(), dtype=torch.float32)
        wg = torch.tensor(rng.random(40), dtype=torch.float32)
        w = torch.maximum(wg, torch.tensor(rng.random(40), dtype=torch.float32))
        for ce_weight in (0.0, 1.0):
            x = torch.tensor(rng.normal(0, 4, 40), dtype=torch.float32, requires_grad=True)
            cp_loss(x, g, wg, w, ce_weight=ce_weight, smooth=1).backward()
            assert bool((x.grad[g == 1] <= 0).all())
            assert bool((x.grad[g == 0] >= 0).all())


@pytest.mark.parametrize("kind", ["bce_dice", "cp"])
def test_gradient_agrees_with_finite_differences(kind):
    rng = np.random.default_rng(1)
    x = torch.tensor(rng.normal(0, 2, 6), dtype=torch.float32, requires_grad=True)
    g, wg, w = (torch.tensor(values, dtype=torch.float32) for values in (rng.random(6) < 0.5, *rng.random((2, 6))))

    def value(logits):
        return bce_dice(logits, g) if kind == "bce_dice" else cp_loss(logits, g, wg, w)

    value(x).backward()
    for pixel in range(6):
        step = torch.zeros(6)
        step[pixel] = 0.02
        with torch.no_grad():
            slope = float(value(x + step) - value(x - step)) / 0.04
        assert float(x.grad[pixel]) == pytest.approx(slope, abs=2e-4)


def test_weights_are_constants_to_the_gradient():
    wg, w = (torch.full((3,), 0.5, requires_grad=True) for _ in range(2))
    x = torch.zeros(3, requires_grad=True)
    cp_loss(x, torch.ones(3), wg, w).backward()
    assert wg.grad is None
    assert w.grad is None


# Robustness


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("road", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["bce_dice", "cp"])
@pytest.mark.parametrize("smooth", [0.0, 1.0])
def test_extreme_logits_give_finite_losses_and_gradients(kind, road, dtype, smooth):
    extremes = [0, 1e-30, 100, -100, 1e4, -1e4, 3e38, -3e38, torch.inf, -torch.inf]
    x = torch.tensor(extremes, requires_grad=True)
    g, ones = torch.full((10,), road), torch.ones(10)
    logits = x.to(dtype)
    loss = bce_dice(logits, g, smooth=smooth) if kind == "bce_dice" else cp_loss(logits, g, ones, ones, smooth=smooth)
    loss.backward()
    assert loss.dtype == torch.float32
    assert bool(torch.isfinite(loss))
    assert bool(torch.isfinite(x.grad).all())


@pytest.mark.parametrize("level", [-100.0, -3.0, 0.0])
@pytest.mark.parametrize("smooth", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["bce_dice", "cp"])
def test_empty_tiles_are_safe(kind, level, smooth):
    logits = torch.full((2, 1, 16, 16), level, requires_grad=True)
    loss = loss_function(LossOptions(warm_up=0, kind=kind, smooth=smooth))(logits, torch.zeros(2, 1, 16, 16), 0)
    loss.backward()
    assert bool(torch.isfinite(loss))
    assert bool(torch.isfinite(logits.grad).all())
    assert bool((logits.grad >= 0).all())


def test_a_confidently_wrong_pixel_keeps_its_gradient():
    x = torch.tensor([-40.0], requires_grad=True)
    cp_loss(x, torch.ones(1), torch.ones(1), torch.ones(1), smooth=1).backward()
    assert float(x.grad) == pytest.approx(-4, abs=1e-3)


def test_shapes_are_not_broadcast():
    with pytest.raises(InputError, match=r"logits have shape \(2, 1, 4, 4\), target and weights \(2, 4, 4\)"):
        bce_dice(torch.zeros(2, 1, 4, 4), torch.zeros(2, 4, 4))


# The loss of a training loop


def test_the_loss_is_that_of_the_weights_of_its_own_prediction():
    logits, target = crossing()
    prediction, reference = (logits[0] > 0).numpy(), (target[0] > 0).numpy()
    weights = connectivity_weights(prediction, reference, sigma=20, buffer="3x3")
    expected = cp_loss(logits[0], target[0], *map(torch.from_numpy, weights), ce_weight=7, smooth=2)
    loss = loss_function(LossOptions(warm_up=0, sigma=20, buffer="3x3", ce_weight=7, smooth=2))
    assert float(loss(logits, target, 0)) == float(expected)


def test_images_have_weights_of_their_own():
    logits, target = crossing()
    both = torch.cat([logits, 6 * target - 3]), torch.cat([target, target])
    loss = loss_function(LossOptions(warm_up=0, ce_weight=1e6, buffer="3x3"))
    alone = [float(loss(part, target, 0)) for part in (logits, 6 * target - 3)]
    assert float(loss(*both, 0)) == pytest.approx(np.mean(alone), rel=1e-5)


def test_the_threshold_decides_what_is_wrong():
    logits, target = crossing()
    hidden = logits.clone()
    hidden[..., 5, 25:45] = -1  # probability 0.27: a ghost for a threshold of 0.2 only
    values = [float(loss_function(LossOptions(warm_up=0, threshold=t))(hidden, target, 0)) for t in (0.2, 0.5)]
    assert values[0] > values[1]


def test_warm_up_is_bce_and_dice():
    logits, target = crossing()
    loss = loss_function(LossOptions(warm_up=3, ce_weight=2))
    values = [float(loss(logits, target, step)) for step in range(5)]
    assert values[:3] == [float(bce_dice(logits, target, ce_weight=2))] * 3
    assert values[3:] == [float(loss_function(LossOptions(warm_up=0, ce_weight=2))(logits, target, 0))] * 2
    assert values[3] != values[2]


def test_training_reconnects_what_the_prediction_cut():
    """Gradient descent on the logits themselves: the gap must close and the ghost must go."""
    logits, target = crossing()
    logits = logits.requires_grad_()
    loss = loss_function(LossOptions(warm_up=0, ce_weight=100))
    optimiser = torch.optim.Adam([logits], lr=0.3)
    for step in range(40):
        optimiser.zero_grad()
        loss(logits, target, step).backward()
        optimiser.step()
    np.testing.assert_array_equal(logits.detach().numpy() > 0, target.numpy() > 0)


def test_missed_road_weighs_more_than_with_plain_entropy():
    logits, target = crossing()
    pulls = []
    for loss in (loss_function(LossOptions(warm_up=0, buffer="3x3")), loss_function(LossOptions(kind="bce_dice"))):
        x = logits.clone().requires_grad_()
        loss(x, target, 0).backward()
        missed, certain = x.grad[0, 0, 24, 25], x.grad[0, 0, 24, 45]
        pulls.append(float(missed / certain))
    assert pulls[0] > 1.5 * pulls[1]


@pytest.mark.parametrize(
    "table",
    [
        {"kind": "mse"},
        {"buffer": "5x5"},
        {"thinning": "lee"},
        {"sigma": 0},
        {"threshold": 1.0},
        {"smooth": -1},
        {"ce_weight": float("nan")},
        {"warm_up": -1},
        {"sigma": "100 px"},
    ],
)
def test_impossible_options_are_refused(table):
    with pytest.raises(OptionError, match=next(iter(table))):
        options_from_table(table, LossOptions)
