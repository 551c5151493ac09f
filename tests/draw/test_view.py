import pytest
from matplotlib.image import imread

from probe2road.draw.view import require_drawable, view
from probe2road.errors import InputError, OptionError, OutputError
from probe2road.graph.roadgraph import empty_graph
from sketches import UTM, fleet_of, graph_of, spaced


@pytest.fixture
def graph():
    return graph_of([(0, 0), (100, 0)], [(100, 0), (100, 50)])


def test_the_suffix_decides_between_page_and_picture(graph, tmp_path):
    fleet = fleet_of(spaced((0, 0), (90, 0)))
    for name in ("roads.html", "roads.HTM"):
        view(graph, tmp_path / name, fleet=fleet, title="A & B", color_by="length")
        assert "<h1>A &amp; B</h1>" in (tmp_path / name).read_text()
    view(graph, tmp_path / "roads.png", fleet=fleet, reference=graph)
    view(graph, tmp_path / "plain.png")
    assert (imread(tmp_path / "roads.png") != imread(tmp_path / "plain.png")).any()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plain.png", "roads.HTM", "roads.html", "roads.png"]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("roads.pdf", {}, r"roads\.pdf: cannot draw \.pdf; use \.html or \.png"),
        ("roads", {}, "cannot draw no suffix"),
        ("roads.html", {"reference": empty_graph(UTM)}, r"a page shows no reference; use \.png"),
        ("roads.png", {"color_by": "length"}, r"a picture is coloured by origin only; use \.html"),
        ("roads.html", {"color_by": "colour"}, "edges cannot be coloured by 'colour'"),
    ],
)
def test_what_a_format_cannot_show_is_refused_and_nothing_is_written(graph, tmp_path, name, options, message):
    with pytest.raises(OptionError, match=message):
        view(graph, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_a_file_name_can_be_checked_before_the_work():
    require_drawable("roads.png")
    with pytest.raises(OptionError, match=r"cannot draw \.gpkg"):
        require_drawable("roads.gpkg")


def test_errors_of_both_formats_pass(graph, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        view(graph, tmp_path / "nowhere" / "roads.html")
    with pytest.raises(OutputError, match="does not exist"):
        view(graph, tmp_path / "nowhere" / "roads.png")
    with pytest.raises(InputError, match="there is nothing to draw"):
        view(empty_graph(UTM), tmp_path / "roads.png")
