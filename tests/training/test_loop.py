import json
import logging
from dataclasses import replace

import numpy as np
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.options import options_from_table
from probe2road.segmentation.losses import LossOptions
from probe2road.training.config import SHIPPED, TrainConfig, ValidationOptions, load_config
from probe2road.training.curves import draw_curves
from probe2road.training.finish import export_best
from probe2road.training.loop import predict_squares, train, use_threads
from probe2road.training.samples import SampleOptions
from probe2road.training.sources import TrainingSource, members
from probe2road.training.validation import validate, validation_squares

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

DATASET = "interchange-diamond-1"
TINY = TrainConfig(
    sources=(TrainingSource(DATASET),),
    sample=SampleOptions(size=64),
    loss=LossOptions(kind="bce_dice"),
    validation=ValidationOptions(sources=(TrainingSource(DATASET),), squares=2, size=256, every=2),
    architecture="compact",
    steps=4,
    batch=2,
)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def weights(state):
    return {name: value.detach().numpy().copy() for name, value in state.network.state_dict().items()}


def scores(state):
    return [{name: value for name, value in row.items() if name != "seconds_per_step"} for row in state.curve]


def test_a_run_that_was_cut_off_goes_on_as_if_it_had_not_been(sets, tmp_path):
    whole = train(TINY, tmp_path / "whole", sets=sets, device="cpu")
    half = train(TINY, tmp_path / "parts", sets=sets, device="cpu", stop_after=0.0)
    assert half.step == 2
    rest = train(TINY, tmp_path / "parts", sets=sets, device="cpu")
    assert rest.step == whole.step == 4
    assert scores(rest) == scores(whole)
    assert [row["step"] for row in rest.curve] == [2, 4]
    for name, value in weights(whole).items():
        assert np.array_equal(value, weights(rest)[name]), name


def test_a_finished_run_leaves_its_log(sets, tmp_path):
    state = train(replace(TINY, steps=2), tmp_path, sets=sets, device="cpu")
    assert json.loads((tmp_path / "curve.json").read_text()) == state.curve
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "tensorboard").glob("events.out.tfevents.*"))


def test_the_loss_falls(sets, tmp_path):
    config = replace(TINY, steps=24, validation=replace(TINY.validation, every=8), precision="fp32")
    curve = train(config, tmp_path, sets=sets, device="cpu").curve
    assert curve[-1]["loss"] < curve[0]["loss"]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_run(name, sets, tmp_path):
    shipped = load_config(name)
    config = replace(
        shipped,
        architecture="compact",
        steps=1,
        batch=2,
        sources=(TrainingSource(DATASET),),
        sample=replace(shipped.sample, size=96, tiles=False),
        validation=TINY.validation,
    )
    state = train(config, tmp_path, sets=sets, device="cpu")
    assert np.isfinite(state.curve[0]["loss"])


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_train_on_what_they_may(name):
    shipped = load_config(name)
    trained = {(source.name, source.split) for source in members(shipped.sources)}
    chosen = {(source.name, source.split) for source in members(shipped.validation.sources)}
    assert not trained & chosen
    assert not {"boston", "hannover", "tokyo_shibuya", "milan"} & {data for data, _ in trained}
    assert {split for data, split in trained if data == "columbus"} == {"train"}


def test_the_paper_s_configuration_is_the_paper_s():
    paper = load_config("paper")
    assert (paper.architecture, paper.batch, paper.learning_rate, paper.schedule) == ("dlinknet50", 2, 2e-4, "constant")
    assert (paper.sample.size, paper.sample.rotation, paper.loss.kind, paper.loss.sigma) == (
        1000,
        "right_angles",
        "cp",
        100.0,
    )
    assert paper.steps == 500 * 110 / 2


def test_validation_is_perfect_for_the_label_and_nothing_for_nothing(sets):
    squares = validation_squares(TINY.validation, TINY.sample, sets)
    perfect = validate(squares, [part.label.astype(np.float32) for part in squares])
    assert perfect["soft_f1"] == 1.0
    assert perfect["geo_f1"] > 0.95
    nothing = validate(squares, [np.zeros(part.label.shape, np.float32) for part in squares])
    assert nothing["score"] == 0.0
    with pytest.raises(InputError, match="no squares"):
        validate([], [])


def test_validation_leaves_the_network_in_evaluation_mode_and_its_statistics_alone(sets, tmp_path):
    state = train(replace(TINY, steps=2), tmp_path, sets=sets, device="cpu")
    before = weights(state)
    squares = validation_squares(TINY.validation, TINY.sample, sets)
    first, second = (predict_squares(state.network, TINY, squares) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert all(np.array_equal(value, before[name]) for name, value in weights(state).items())


def test_a_folder_of_another_run_is_refused(sets, tmp_path):
    train(replace(TINY, steps=2), tmp_path, sets=sets, device="cpu")
    with pytest.raises(InputError, match="another seed, steps; use another output folder"):
        train(replace(TINY, seed=2), tmp_path, sets=sets, device="cpu")


def test_a_damaged_checkpoint_is_named(sets, tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match=r"checkpoint\.pt: is no checkpoint of ours; remove it to begin anew"):
        train(TINY, tmp_path, sets=sets, device="cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_absent(sets, tmp_path):
    with pytest.raises(OptionError, match="there is no GPU that torch can use; use cpu"):
        train(TINY, tmp_path, sets=sets, device="cuda")


def test_configurations_that_cannot_run_are_refused():
    with pytest.raises(OptionError, match=r"channels\[0\] is 'speed'; use traces"):
        TrainConfig(channels=("speed",))
    with pytest.raises(OptionError, match="schedule is 'linear'; use constant or cosine"):
        TrainConfig(schedule="linear")
    with pytest.raises(OptionError, match="steps is 0"):
        TrainConfig(steps=0)
    with pytest.raises(OptionError, match="no sources"):
        TrainConfig(sources=(TrainingSource(DATASET, weight=0.0),))
    with pytest.raises(OptionError, match="threads is 0"):
        use_threads(0)
    with pytest.raises(OptionError, match=r"sources\[0\]: there is no option 'nam'"):
        options_from_table({"sources": [{"nam": "porto"}]}, TrainConfig)


def test_best_weights_need_a_validation(tmp_path):
    with pytest.raises(InputError, match="train at least to the first validation"):
        export_best(TINY, None, tmp_path, sets=tmp_path)


def test_a_curve_is_drawn(tmp_path):
    names = ("step", "loss", "soft_f1", "geo_f1", "geo_precision", "geo_recall")
    draw_curves([dict.fromkeys(names, 1.0), dict.fromkeys(names, 2.0)], tmp_path / "curve.png", title="a run")
    assert (tmp_path / "curve.png").stat().st_size > 5000


def test_the_log_says_how_it_goes(sets, tmp_path, caplog):
    with caplog.at_level(logging.INFO, logger="probe2road"):
        train(replace(TINY, steps=2), tmp_path, sets=sets, device="cpu")
    assert "step 2: loss" in caplog.text
    assert "vectorised" not in caplog.text  # of the graphs that validation draws
