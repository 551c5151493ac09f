"""The network, a few steps of its training, and the whole method with what they leave."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from probe2road.baselines.deepmg.features import FeatureOptions, thin_traces  # noqa: E402
from probe2road.baselines.deepmg.prediction import load_network, predict_windows, save_network  # noqa: E402
from probe2road.baselines.deepmg.recipe import DeepMGOptions, build_deepmg  # noqa: E402
from probe2road.baselines.deepmg.t2rnet import T2RNet, soft_dice_loss, t2rnet_loss  # noqa: E402
from probe2road.baselines.deepmg.tiles import TileSet, open_tiles, read_batch, tile_grids, write_tiles  # noqa: E402
from probe2road.baselines.deepmg.training import TrainOptions, train  # noqa: E402
from probe2road.errors import InputError, OptionError  # noqa: E402
from probe2road.fleet.contract import Fleet  # noqa: E402
from probe2road.graph.check import check_graph  # noqa: E402
from probe2road.raster.counts import fleet_grid  # noqa: E402
from sketches import UTM, fleet_of, graph_of, spaced  # noqa: E402

QUICK = TrainOptions(width=2, epochs=2, learning_rate=0.01, validate_every=1)


@pytest.fixture(scope="module")
def drives() -> Fleet:
    """Two streets of 1 km that cross, driven five times each."""
    ways = [spaced((12, 300), (1000, 300), spacing=12.0), spaced((500, 12), (500, 1000), spacing=12.0)]
    return fleet_of(*ways * 5, interval=0.8)


@pytest.fixture(scope="module")
def tiles(drives: Fleet, tmp_path_factory: pytest.TempPathFactory) -> TileSet:
    roads = graph_of([(0, 300), (1000, 300)], [(500, 0), (500, 1000)])
    south_west = tile_grids([shapely.box(0, 0, 1000, 1000)], resolution=2.0, crs=UTM)[2:3]
    folder = tmp_path_factory.mktemp("tiles") / "train"
    return write_tiles(folder, thin_traces(drives), roads, south_west, variant="fixed", features=FeatureOptions())


def test_parameters_add_up() -> None:
    def block(i: int, o: int) -> int:  # two convolutions with bias, two normalisations with scale and shift
        return 9 * i * o + o + 2 * o + 9 * o * o + o + 2 * o

    transition = 128 * 64 + 64 + 64 * 8 + 8
    encoder = block(19, 64) + block(64, 128) + block(128, 256) + block(256, 512) + block(512, 1024)
    raised = 2 * 16 * (1024 * 512 + 512 * 256 + 256 * 128 + 128 * 64)
    region = block(1024, 512) + block(512, 256) + block(256, 128) + block(128, 64)
    line = block(1536, 512) + block(768, 256) + block(384, 128) + block(192, 64)
    heads = 2 * (9 * 64 + 1)
    total = transition + encoder + raised + region + line + heads
    with torch.device("meta"):
        network = T2RNet()
    assert sum(parameter.numel() for parameter in network.parameters()) == total == 63_098_122


def test_cells_without_neighbours_get_one_embedding() -> None:
    network = T2RNet(width=2).eval()
    embedded = network.transition(torch.zeros(1, 128, 3, 3))
    assert embedded.shape == (1, 8, 3, 3)
    assert (embedded == embedded[:, :, :1, :1]).all()


def test_loss_of_hand_made_tiles() -> None:
    probability, label = torch.tensor([[1.0, 0.5], [0.0, 0.5]]), torch.tensor([[1.0, 1.0], [0.0, 0.0]])
    # 1 - (2 * 1.5 + 1) / (2 + 2 + 1)
    assert soft_dice_loss(probability, label).item() == pytest.approx(0.2)
    assert soft_dice_loss(label, label).item() == 0.0
    assert soft_dice_loss(torch.zeros(2, 2), torch.zeros(2, 2)).item() == 0.0
    both = t2rnet_loss((probability, label), label, label)
    assert both.item() == pytest.approx(0.8 * 0.2)


def test_tiles_hold_features_and_labels(tiles: TileSet) -> None:
    assert tiles == open_tiles(tiles.folder)
    assert tiles.count == 1
    batch = read_batch(tiles, [0])  # its corners are (0, 0) and (512, 512)
    row = (512 - 300) // 2 - 1  # y = 300 is the border of two rows, and belongs to the upper
    assert np.flatnonzero(batch.line[0, :, 10]).tolist() == [row]
    assert np.flatnonzero(batch.region[0, :, 10]).tolist() == list(range(row - 2, row + 3))
    np.testing.assert_allclose(batch.planes[0, 1, row - 1 : row + 3, 10], np.log10([1, 3.5, 3.5, 1]), rtol=1e-6)


def test_tiles_without_a_fix_are_left_out(drives: Fleet, tmp_path: Path) -> None:
    grids = tile_grids([shapely.box(5000, 0, 6000, 1000)], resolution=2.0, crs=UTM)
    roads = graph_of([(0, 300), (1000, 300)])
    made = write_tiles(tmp_path / "t", thin_traces(drives), roads, grids, variant="fixed", features=FeatureOptions())
    assert made.count == 0
    with pytest.raises(InputError, match="there are none"):
        train(made, made, tmp_path / "run", QUICK)


def test_training_lowers_the_loss_and_goes_on_as_if_it_had_not_stopped(tiles: TileSet, tmp_path: Path) -> None:
    options = TrainOptions(width=2, epochs=4, learning_rate=0.01, validate_every=1)
    train(tiles, tiles, tmp_path / "whole", options)
    for epochs in (2, 4):
        stopped = TrainOptions(width=2, epochs=epochs, learning_rate=0.01, validate_every=1)
        train(tiles, tiles, tmp_path / "parts", stopped)
    whole, parts = (torch.load(tmp_path / name / "checkpoint.pt", weights_only=True) for name in ("whole", "parts"))
    for name, weights in whole["network"].items():
        torch.testing.assert_close(weights, parts["network"][name], rtol=1e-4, atol=1e-5)
    losses = [row["loss"] for row in whole["history"]]
    assert losses[-1] < losses[0]
    assert len((tmp_path / "whole" / "history.csv").read_text().splitlines()) == 5
    with pytest.raises(OptionError, match="other options"):
        train(tiles, tiles, tmp_path / "whole", TrainOptions(width=2, epochs=9))


def test_prediction_answers_for_driven_windows_and_each_cell_once(drives: Fleet, tmp_path: Path) -> None:
    save_network(T2RNet(1), tmp_path / "w.pt", variant="fixed", features=FeatureOptions())
    grid = fleet_grid(drives, resolution=2.0)
    parts = list(predict_windows(load_network(tmp_path / "w.pt"), thin_traces(drives), grid))
    assert [(window.row, window.col) for window, _ in parts] == [(0, 256), (256, 0), (256, 256), (256, 512), (512, 256)]
    assert all(part.shape == (window.rows, window.cols) for window, part in parts)


def test_the_whole_method_gives_a_valid_graph(drives: Fleet, tiles: TileSet, tmp_path: Path) -> None:
    weights = train(tiles, tiles, tmp_path / "run", QUICK)
    options = DeepMGOptions(weights=str(weights), threshold=0.6)
    graph = build_deepmg(drives, options=options, workspace=tmp_path / "work")
    check_graph(graph)
    assert (tmp_path / "work" / "1-probability.tif").exists()
    again = build_deepmg(drives, options=options, workspace=tmp_path / "work")
    assert again.edges["length"].tolist() == pytest.approx(graph.edges["length"].tolist())
    with pytest.raises(OptionError, match="weights are of the variant fixed"):
        build_deepmg(drives, options=DeepMGOptions(weights=str(weights), variant="as_published"))


def test_missing_and_foreign_weights_are_refused(drives: Fleet, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file of weights"):
        build_deepmg(drives)
    (tmp_path / "w.pt").write_text("not a network")
    with pytest.raises(InputError, match="not weights of T2RNet"):
        build_deepmg(drives, options=DeepMGOptions(weights=str(tmp_path / "w.pt")))
