"""LPIPS equals the published network, and is unavailable without its weights."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from hashlib import sha256
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from pipeline.command.main import main
from pipeline.metrics import lpips
from pipeline.metrics.lpips import FETCH, LPIPS_VARIANTS, lpips_available
from pipeline.runtime.download import RemoteFile
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError

# (index in torchvision's features, channels in, channels out, kernel)
LAYERS = {
    "vgg": [
        (0, 3, 64, 3),
        (2, 64, 64, 3),
        (5, 64, 128, 3),
        (7, 128, 128, 3),
        (10, 128, 256, 3),
        (12, 256, 256, 3),
        (14, 256, 256, 3),
        (17, 256, 512, 3),
        (19, 512, 512, 3),
        (21, 512, 512, 3),
        (24, 512, 512, 3),
        (26, 512, 512, 3),
        (28, 512, 512, 3),
    ],
    "alex": [
        (0, 3, 64, 11),
        (3, 64, 192, 5),
        (6, 192, 384, 3),
        (8, 384, 256, 3),
        (10, 256, 256, 3),
    ],
}
TAPS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
FILES = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}


@pytest.fixture
def checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def save_weights(folder: Path, net: str) -> None:
    import torch

    generator = torch.Generator().manual_seed(1)
    state = {}
    for index, inputs, outputs, kernel in LAYERS[net]:
        weight = torch.randn(outputs, inputs, kernel, kernel, generator=generator)
        state[f"features.{index}.weight"] = weight / (inputs * kernel * kernel) ** 0.5
        state[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    torch.save(state, folder / FILES[net])
    heads = {
        f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for i, channels in enumerate(TAPS[net])
    }
    torch.save(heads, folder / f"lpips_{net}.pth")


def pictures() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    reference = rng.random((40, 52, 3))
    return np.clip(reference + rng.normal(0, 0.2, reference.shape), 0, 1), reference


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_missing_weights_are_reported_with_the_command_that_downloads_them(
    checkpoints, net
) -> None:
    save_weights(checkpoints, net)
    (checkpoints / f"lpips_{net}.pth").unlink()
    measure, reason = lpips_available(net)
    assert measure is None
    assert reason.endswith(FETCH[net])
    assert str(checkpoints) not in reason, "a path of this machine would stand in metrics.json"


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_digests_are_those_in_the_names_of_torchvisions_files(net) -> None:
    backbone = lpips._NETWORKS[net].backbone
    assert backbone.url.endswith(backbone.name)
    assert f"-{backbone.sha256[:8]}." in backbone.name and len(backbone.sha256) == 64


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A server's folder with small weights; those of VGG are expected to be these files."""
    folder = tmp_path / "published"
    folder.mkdir()

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    files = []
    for name, data in (("vgg16-397923af.pth", bytes(2_500_000)), ("lpips_vgg.pth", b"heads")):
        (folder / name).write_bytes(data)
        url = f"http://127.0.0.1:{server.server_port}/{name}"
        files.append(RemoteFile(name, url, len(data), sha256(data).hexdigest()))
    network = replace(lpips._NETWORKS["vgg"], backbone=files[0], heads=files[1])
    monkeypatch.setitem(lpips._NETWORKS, "vgg", network)
    yield folder
    server.shutdown()
    server.server_close()


def test_weights_are_downloaded_once_and_repaired(published, checkpoints, capsys) -> None:
    (checkpoints / "vgg16-397923af.pth").write_bytes(b"cut off")
    (checkpoints / "vgg.pth").write_bytes(b"another program's")
    assert main(["fetch", "lpips"]) == 0
    assert capsys.readouterr().out.count("downloaded from http") == 2
    assert {path.name for path in checkpoints.iterdir()} == {
        *("vgg16-397923af.pth", "lpips_vgg.pth", "vgg.pth")
    }
    for file in published.iterdir():
        assert (checkpoints / file.name).read_bytes() == file.read_bytes()
        file.unlink()
    assert main(["fetch", "lpips"]) == 0
    assert capsys.readouterr().out.count("was there") == 2


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (bytes(2_499_999) + b"x", "2500000 bytes with the SHA-256 digest"),
        (bytes(1_000), "found 1000 bytes"),
        (bytes(9_000_000), "found more than 3000000 bytes"),
        (None, "File not found"),
    ],
    ids=["other content", "cut off", "too long", "missing"],
)
def test_a_failed_download_leaves_no_file_and_says_why(
    published, checkpoints, capsys, sent, words
) -> None:
    file = published / "vgg16-397923af.pth"
    file.unlink() if sent is None else file.write_bytes(sent)
    assert main(["fetch", "lpips"]) == EXIT_USER_ERROR
    message = capsys.readouterr().err
    assert words in message and "http://127.0.0.1" in message and "what to do" in message
    assert list(checkpoints.iterdir()) == []


def test_invalid_weight_files_are_reported(checkpoints) -> None:
    save_weights(checkpoints, "alex")
    whole = (checkpoints / FILES["alex"]).read_bytes()
    (checkpoints / FILES["alex"]).write_bytes(whole[: len(whole) // 2])
    measure, reason = lpips_available("alex")
    assert measure is None and FILES["alex"] in reason
    (checkpoints / FILES["alex"]).write_bytes((checkpoints / "lpips_alex.pth").read_bytes())
    measure, reason = lpips_available("alex")
    assert measure is None and "features.0" in reason


def test_none_is_reported_as_switched_off() -> None:
    assert lpips_available("none") == (None, "switched off")


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_distance_is_zero_for_equal_images_symmetric_and_positive(checkpoints, net) -> None:
    save_weights(checkpoints, net)
    measure, reason = lpips_available(net)
    assert measure is not None and reason == ""
    image, reference = pictures()
    assert measure(image, image, None) == 0.0
    assert measure(image, reference, None) > 1e-3
    assert measure(image, reference, None) == pytest.approx(measure(reference, image, None))
    assert net.upper()[:3] in LPIPS_VARIANTS[net].upper()


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_distance_equals_the_published_network_built_from_modules(checkpoints, net) -> None:
    """Against nn.Sequential in torchvision's layer order: an independent implementation of the
    indices, strides, pooling and compared layers."""
    import torch
    from torch import nn

    save_weights(checkpoints, net)
    modules: list[nn.Module] = []
    if net == "vgg":
        channels = 3
        for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
            if width == 0:
                modules.append(nn.MaxPool2d(2, 2))
            else:
                modules += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
        taps = (3, 8, 15, 22, 29)
    else:
        modules = [
            *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
        ]
        taps = (1, 4, 7, 9, 11)
    features = nn.Sequential(*modules)
    state = torch.load(checkpoints / FILES[net], weights_only=True)
    features.load_state_dict({k.removeprefix("features."): v for k, v in state.items()})
    heads = torch.load(checkpoints / f"lpips_{net}.pth", weights_only=True)

    def taps_of(picture: np.ndarray) -> list[torch.Tensor]:
        x = torch.tensor(picture, dtype=torch.float32).permute(2, 0, 1)[None]
        x = (x - torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)) / torch.tensor(
            [0.458, 0.448, 0.450]
        ).view(3, 1, 1)
        found = []
        for i, module in enumerate(features):
            x = module(x)
            if i in taps:
                found.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return found

    image, reference = pictures()
    with torch.no_grad():
        expected = sum(
            float((heads[f"lin{i}.model.1.weight"] * (a - b) ** 2).sum(1).mean())
            for i, (a, b) in enumerate(zip(taps_of(image), taps_of(reference), strict=True))
        )
    measure, _ = lpips_available(net)
    assert measure is not None
    assert measure(image, reference, None) == pytest.approx(expected, rel=1e-5)


def test_masked_pixels_have_no_influence_and_are_not_averaged(checkpoints) -> None:
    save_weights(checkpoints, "alex")
    measure, _ = lpips_available("alex")
    assert measure is not None
    image, reference = pictures()
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[:, :26] = 255
    junk = np.where(mask[..., None] != 0, image, 0.123)
    masked = measure(image, reference, mask)
    assert measure(junk, reference, mask) == masked
    # Half the picture agrees perfectly by construction; a plain mean would be halved by it.
    half = np.where(mask[..., None] != 0, image, reference)
    assert masked > 1.3 * measure(half, reference, None)


def test_the_same_bits_on_any_number_of_threads(checkpoints) -> None:
    import torch

    save_weights(checkpoints, "vgg")
    measure, _ = lpips_available("vgg")
    assert measure is not None
    image, reference = pictures()
    before = torch.get_num_threads()
    try:
        values = set()
        for threads in (1, 2):
            torch.set_num_threads(threads)
            values.add(measure(image, reference, None))
    finally:
        torch.set_num_threads(before)
    assert len(values) == 1


def test_images_too_small_for_the_network_are_rejected(checkpoints) -> None:
    save_weights(checkpoints, "alex")
    measure, _ = lpips_available("alex")
    assert measure is not None
    small = np.zeros((31, 64, 3))
    with pytest.raises(UserError, match="32 x 32"):
        measure(small, small, None)
