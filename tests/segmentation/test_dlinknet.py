import pytest

torch = pytest.importorskip("torch")

from probe2road.errors import OptionError  # noqa: E402
from probe2road.segmentation.attention import positions  # noqa: E402
from probe2road.segmentation.dlinknet import ARCHITECTURES, Architecture, DLinkNet, find_architecture  # noqa: E402


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("architecture", "encoder", "centre", "decoders", "head"),
    [
        ("dlinknet34", 21_284_672, 9_439_232, 329_888, 42_337),
        ("dlinknet50", 23_508_032, 188_753_920, 5_242_496, 140_641),
        ("dlinknet101", 42_500_160, 188_753_920, 5_242_496, 140_641),
    ],
)
def test_published_networks_have_the_published_numbers_of_parameters(architecture, encoder, centre, decoders, head):
    with torch.device("meta"):
        network = DLinkNet(find_architecture(architecture))
    assert count(network.centre) == centre
    assert sum(count(getattr(network, f"decoder{n}")) for n in (1, 2, 3, 4)) == decoders
    assert count(network.head) == head
    assert count(network) == encoder + centre + decoders + head


def test_fifty_layers_with_four_dilated_convolutions():
    with torch.device("meta"):
        assert count(DLinkNet(Architecture(bottleneck=True))) == 179_894_305


def test_one_input_channel_saves_two_kernels_of_the_stem():
    with torch.device("meta"):
        three, one = (DLinkNet(find_architecture("dlinknet34"), channels=n) for n in (3, 1))
    assert count(three) - count(one) == 2 * 7 * 7 * 64


def test_encoder_has_the_names_of_torchvision():
    with torch.device("meta"):
        names = {name for name, _ in DLinkNet(find_architecture("dlinknet50")).named_parameters()}
    assert {"conv1.weight", "bn1.bias", "layer1.0.conv3.weight", "layer4.2.bn2.weight"} <= names
    assert "layer2.0.downsample.0.weight" in names


@pytest.mark.parametrize("name", [name for name in ARCHITECTURES if name.startswith("compact")])
@pytest.mark.parametrize("size", [(64, 64), (1, 1), (33, 70), (100, 31)])
def test_output_has_the_size_of_the_input(name, size):
    network = DLinkNet(find_architecture(name), channels=2).eval()
    with torch.no_grad():
        assert network(torch.rand(2, 2, *size)).shape == (2, 1, *size)


def test_thousand_pixels_are_padded_by_twelve_on_each_side():
    network = DLinkNet(find_architecture("compact"), channels=1).eval()
    x = torch.rand(1, 1, 40, 40)
    by_hand = torch.nn.functional.pad(x, (12, 12, 12, 12))
    with torch.no_grad():
        assert torch.equal(network(x), network(by_hand)[..., 12:52, 12:52])


def test_every_parameter_learns():
    for name in (name for name in ARCHITECTURES if name.startswith("compact")):
        network = DLinkNet(find_architecture(name))
        network(torch.rand(2, 3, 64, 64)).square().mean().backward()
        assert [key for key, value in network.named_parameters() if value.grad is None] == []


def test_receptive_field_of_the_centre_follows_its_dilations():
    centre = DLinkNet(Architecture(width=8, dilations=(1, 2))).centre
    for convolution in centre.dilated:
        torch.nn.init.constant_(convolution.weight, 1.0)
    x = torch.zeros(1, 64, 15, 15)
    x[..., 7, 7] = 1.0
    with torch.no_grad():
        reached = (centre(x)[0, 0, 7] > 0).nonzero().flatten()
    assert (reached.min(), reached.max()) == (4, 10)  # one and two pixels on each side, in a row


def test_positions_tell_places_apart():
    encoded = positions(torch.zeros(1, 16, 6, 5)).flatten(2)[0].T
    assert len(torch.unique(encoded.round(decimals=4), dim=0)) == 30


def test_unknown_names_and_sizes_are_refused():
    with pytest.raises(OptionError, match="there is no architecture 'unet'; use one of dlinknet34"):
        find_architecture("unet")
    with pytest.raises(OptionError, match="centre is 'lstm'; use dilated or transformer"):
        Architecture(centre="lstm")
    with pytest.raises(OptionError, match="width is 12"):
        Architecture(width=12)
