"""LPIPS v0.1 (Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual
Metric", 2018), computed if its trained weights are on this machine. ``fetch_weights`` downloads
them; nothing else does. Without the weights, or with wrong ones, the metric is unavailable and the
reason is reported.

Two files are needed, both in ``$TORCH_HOME/hub/checkpoints`` (``~/.cache/torch`` by default):

- the backbone, torchvision's ImageNet weights: ``vgg16-397923af.pth`` or
  ``alexnet-owt-7be5be79.pth``;
- the linear heads of the LPIPS authors' release v0.1: ``lpips_vgg.pth`` or ``lpips_alex.pth``
  (or ``vgg.pth``, ``alex.pth``, the names under which other programs store them).

Inputs are in [0, 1], as for the published figures of 3DGS, although the network was trained on
[-1, 1].
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.download import RemoteFile
from pipeline.runtime.errors import UserError
from pipeline.runtime.torch_threads import single_torch_thread

if TYPE_CHECKING:
    import torch

Net = Literal["vgg", "alex", "none"]
Lpips = Callable[[NDArray[Any], NDArray[Any], NDArray[Any] | None], float]

LPIPS_VARIANTS: dict[str, str] = {
    "vgg": "LPIPS v0.1, VGG16, inputs [0,1] as INRIA",
    "alex": "LPIPS v0.1, AlexNet, inputs [0,1] as INRIA",
}

FETCH: dict[str, str] = {
    "vgg": "splatmake fetch lpips",
    "alex": "splatmake fetch lpips --net alex",
}
"""The command that downloads the weights."""

MIN_SIDE = 32
"""Least side of an image in pixels: the networks reduce smaller images to nothing."""

# The authors' input normalisation: ImageNet's mean and standard deviation, for inputs in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
# Avoids division by zero for all-zero feature vectors, as in the authors' release.
_EPSILON = 1e-10


@dataclass(frozen=True)
class _Conv:
    """A convolution with ReLU: its index in torchvision's ``features``, output channels, kernel,
    stride, padding; the max-pooling (kernel, stride) before it; whether LPIPS reads its output."""

    index: int
    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: tuple[int, int] | None = None
    tap: bool = False


@dataclass(frozen=True)
class _Network:
    """A network with its weights; other programs store the heads as ``other_name``."""

    backbone: RemoteFile
    heads: RemoteFile
    other_name: str
    convs: tuple[_Conv, ...]


_BACKBONES = "https://download.pytorch.org/models"
_HEADS = "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1"
_NETWORKS = {
    "vgg": _Network(
        RemoteFile(
            "vgg16-397923af.pth",
            f"{_BACKBONES}/vgg16-397923af.pth",
            553_433_881,
            "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        ),
        RemoteFile(
            "lpips_vgg.pth",
            f"{_HEADS}/vgg.pth",
            7289,
            "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
        ),
        "vgg.pth",
        (
            _Conv(0, 64),
            _Conv(2, 64, tap=True),
            _Conv(5, 128, pool=(2, 2)),
            _Conv(7, 128, tap=True),
            _Conv(10, 256, pool=(2, 2)),
            _Conv(12, 256),
            _Conv(14, 256, tap=True),
            _Conv(17, 512, pool=(2, 2)),
            _Conv(19, 512),
            _Conv(21, 512, tap=True),
            _Conv(24, 512, pool=(2, 2)),
            _Conv(26, 512),
            _Conv(28, 512, tap=True),
        ),
    ),
    "alex": _Network(
        RemoteFile(
            "alexnet-owt-7be5be79.pth",
            f"{_BACKBONES}/alexnet-owt-7be5be79.pth",
            244_408_911,
            "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        ),
        RemoteFile(
            "lpips_alex.pth",
            f"{_HEADS}/alex.pth",
            6009,
            "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        ),
        "alex.pth",
        (
            _Conv(0, 64, kernel=11, stride=4, padding=2, tap=True),
            _Conv(3, 192, kernel=5, padding=2, pool=(3, 2), tap=True),
            _Conv(6, 384, pool=(3, 2), tap=True),
            _Conv(8, 256, tap=True),
            _Conv(10, 256, tap=True),
        ),
    ),
}


def _weight_files(network: _Network) -> tuple[Path, Path]:
    """Paths of the backbone and of the linear heads in torch.hub's folder; they may not exist."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", os.path.join(cache, "torch"))
    folder = Path(home).expanduser() / "hub" / "checkpoints"
    heads, other = folder / network.heads.name, folder / network.other_name
    if other.is_file() and not heads.is_file():
        heads = other
    return folder / network.backbone.name, heads


def weights_found(net: Net) -> dict[str, int]:
    """Names and sizes in bytes of the weight files that exist. Does not import torch."""
    files = () if net == "none" else _weight_files(_NETWORKS[net])
    return {file.name: file.stat().st_size for file in files if file.is_file()}


def fetch_weights(net: Net) -> list[str]:
    """Download the weight files that are missing or not the published ones.

    Returns:
        A line for each file, with where it is.

    Raises:
        UserError: A file cannot be downloaded.
    """
    lines = []
    network = _NETWORKS[net]
    for file, path in zip((network.backbone, network.heads), _weight_files(network), strict=True):
        found = file.is_at(path)
        if not found:
            # Heads of another name may be those of another program's release.
            path = path.with_name(file.name)
            file.download(path)
        lines.append(f"{path}: {'was there' if found else f'downloaded from {file.url}'}")
    return lines


def _reason(file: Path, what: str, error: Exception) -> str:
    return f"{file.name} {what}: {error}".replace(str(file.parent), "...")


def lpips_available(net: Net) -> tuple[Lpips | None, str]:
    """The metric, or None and why there is none.

    Returns:
        ``(measure, "")``, or ``(None, reason)`` where a file is missing or not what it should
        be. The reason becomes part of the result: it holds no path of this machine.
        ``measure(image, reference, mask)`` takes (H, W, 3), floats in [0, 1] or uint8 where 255
        represents 1, and a mask (H, W) or None, and returns the distance (0 for identical
        pictures). Masked (zero) pixels of the image are replaced by the reference's and each layer
        is averaged by how much of it is unmasked. It raises UserError for pictures under
        ``MIN_SIDE`` pixels.
    """
    if net == "none":
        return None, "switched off"
    network = _NETWORKS[net]
    backbone_file, heads_file = _weight_files(network)
    if not (backbone_file.is_file() and heads_file.is_file()):
        return None, f"its weights are not on this machine: run {FETCH[net]}"
    try:
        weights = _backbone(_load(backbone_file), network)
    except Exception as error:
        what = f"is not torchvision's {network.backbone.name}"
        return None, _reason(backbone_file, what, error)
    try:
        heads = _heads(_load(heads_file), network)
    except Exception as error:
        return None, _reason(heads_file, "does not hold the linear heads of LPIPS v0.1", error)

    def measure(
        image: NDArray[Any], reference: NDArray[Any], mask: NDArray[Any] | None = None
    ) -> float:
        return _distance(network, weights, heads, image, reference, mask)

    return measure, ""


def _load(file: Path) -> dict[str, torch.Tensor]:
    import torch

    return torch.load(file, map_location="cpu", weights_only=True)


def _expect(tensor: torch.Tensor, name: str, shape: tuple[int, ...]) -> torch.Tensor:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
    return tensor.detach().float()


def _backbone(
    state: dict[str, torch.Tensor], network: _Network
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    weights, channels = [], 3
    for conv in network.convs:
        name = f"features.{conv.index}"
        shape = (conv.channels, channels, conv.kernel, conv.kernel)
        weight = _expect(state[f"{name}.weight"], f"{name}.weight", shape)
        bias = _expect(state[f"{name}.bias"], f"{name}.bias", (conv.channels,))
        weights.append((weight, bias))
        channels = conv.channels
    return weights


def _heads(state: dict[str, torch.Tensor], network: _Network) -> list[torch.Tensor]:
    taps = [conv for conv in network.convs if conv.tap]
    names = [f"lin{layer}.model.1.weight" for layer in range(len(taps))]
    return [
        _expect(state[name], name, (1, conv.channels, 1, 1))
        for name, conv in zip(names, taps, strict=True)
    ]


def _distance(
    network: _Network,
    weights: list[tuple[torch.Tensor, torch.Tensor]],
    heads: list[torch.Tensor],
    image: NDArray[Any],
    reference: NDArray[Any],
    mask: NDArray[Any] | None,
) -> float:
    import torch
    import torch.nn.functional as F

    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE:
        raise UserError(
            f"LPIPS needs images of at least {MIN_SIDE} x {MIN_SIDE} pixels, "
            f"found {width} x {height}",
            fix="use larger images, or evaluate without it (lpips_net: none)",
        )
    keep = np.ones((height, width), bool) if mask is None else mask != 0
    if not keep.any():
        raise UserError("the mask leaves no pixel to measure", fix="leave this view out")
    image = np.where(keep[..., None], image, reference)

    unmasked = torch.from_numpy(keep.astype(np.float32))[None, None]
    # torch's convolutions round differently with the number of threads, so each image is
    # processed by a single thread.
    each = ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(1,))
    taps = [_taps(network, weights, picture) for picture in (image, reference)]
    with single_torch_thread(), each as pool:
        total = 0.0
        for head in heads:
            a, b = pool.map(next, taps)
            distance = F.conv2d((a - b) ** 2, head)[0, 0]
            share = F.adaptive_avg_pool2d(unmasked, (distance.shape[0], distance.shape[1]))[0, 0]
            d, s = (t.numpy().astype(np.float64) for t in (distance, share))
            total += float(np.sum(d * s) / np.sum(s))
    return total


def _taps(
    network: _Network, weights: list[tuple[torch.Tensor, torch.Tensor]], picture: NDArray[Any]
) -> Iterator[torch.Tensor]:
    """Outputs of the layers that LPIPS compares, (1, C, h, w) each, normalised over channels;
    computed one by one, because those of all layers take a lot of memory."""
    import torch
    import torch.nn.functional as F

    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
    unit = picture / 255.0 if picture.dtype == np.uint8 else picture
    x = torch.from_numpy(unit.astype(np.float32)).permute(2, 0, 1)[None]
    x = (x - shift) / scale
    for conv, (weight, bias) in zip(network.convs, weights, strict=True):
        if conv.pool is not None:
            x = F.max_pool2d(x, *conv.pool)
        x = F.conv2d(x, weight, bias, stride=conv.stride, padding=conv.padding).relu_()
        if conv.tap:
            length = x.square().sum(dim=1, keepdim=True).sqrt()
            yield x / (length + _EPSILON)
