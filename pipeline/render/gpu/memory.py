"""The memory of training on a device, known before it starts."""

from __future__ import annotations

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Gpu, too_large
from pipeline.render.resident import TrainingSize

# The mean number of tiles that a Gaussian of a typical trained scene overlaps.
PAIRS_PER_GAUSSIAN = 8
# The bytes of a Gaussian (counts, radii and ranks), of a pair (keys and values of sorting) and of a
# pixel (images and their gradients) in the arrays that are not the largest.
GAUSSIAN_BYTES, PAIR_BYTES, PIXEL_BYTES = 48, 20, 36

# The gradients that steps write at most; most write none of them.
ALL_GRADIENTS = layout.written_gradients(camera=True, colors=True, frames=False)


def large_arrays(size: TrainingSize) -> dict[str, int]:
    """Bytes of the arrays that can exceed the limit of one buffer."""
    count = size.gaussians
    return {
        "SH coefficients": 12 * size.sh_coefficients * count,
        "gradients": 4 * layout.floats(ALL_GRADIENTS) * count,
        "slots of gradients": layout.SLOT_BYTES * PAIRS_PER_GAUSSIAN * count,
        "image": 12 * size.pixels,
    }


def training_bytes(size: TrainingSize, cached: int) -> int:
    """The bytes of all arrays.

    Args:
        cached: The maximum bytes of the training images on the device.
    """
    per_gaussian = layout.RECORD_BYTES + GAUSSIAN_BYTES
    per_gaussian += PAIRS_PER_GAUSSIAN * PAIR_BYTES
    # Geometry with two moments, the moments of SH (see ``ShAdam``), and SH once more while rows
    # of them are selected.
    moments = 3 * 4 * layout.floats(layout.GEOMETRY) + (10 + 12) * size.sh_coefficients
    return (
        sum(large_arrays(size).values())
        + (moments + per_gaussian) * size.gaussians
        + PIXEL_BYTES * size.pixels
        + min(cached, size.image_bytes)
    )


def memory_line(gpu: Gpu, size: TrainingSize, cached: int) -> str:
    """Return a line for the log.

    Raises:
        UserError: An array is larger than the device's buffers can be.
    """
    arrays = large_arrays(size)
    name = max(arrays, key=lambda each: arrays[each])
    if arrays[name] > gpu.max_bytes:
        raise too_large(name, arrays[name], gpu)
    return (
        f"{gpu.adapter}: about {training_bytes(size, cached) / 1e6:.0f} MB of its memory for up to "
        f"{size.gaussians} Gaussians and images of {size.pixels / 1e6:.2f} megapixels"
    )
