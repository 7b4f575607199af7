"""``coverage.json``: complete, same at any number of threads, and low trust means high error."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.config.schema import Evaluate, Split, Train
from pipeline.coverage.measure import WorldFrame, measure_coverage, spearman
from pipeline.coverage.record import CoverageRecord
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.protocol import choose_protocol
from pipeline.render.views import to_bytes
from pipeline.splats.gaussians import Gaussians
from tests.coverage.scenes import UP, camera, renderer, wall

TRAIN = Train(background="black", appearance="none", sh_degree=0)


def measured(folder: Path, *, threads: int = 1, with_test_view: bool = True) -> CoverageRecord:
    """Coverage of a wall photographed on its left side, with a test view of the right side, whose
    colours are wrong."""
    truth = wall()
    truth.sh[:] = torch.rand(truth.sh.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    x = truth.means[:, :1, None]
    wrong = truth.sh + torch.rand_like(truth.sh) * 0.1 + (x > 2.6) * 1.5
    scene = Gaussians(*truth.parameters()[:4], wrong)
    views = [camera(f"{i}.png", (-2 + 0.4 * i, 0.2 * (i % 3), 0)) for i in range(8)]
    views.append(camera("right.png", (1.6, 0, 0), test=with_test_view))
    folder.mkdir(parents=True)
    for i, view in enumerate(views):
        path = folder / view.name
        Image.fromarray(to_bytes(renderer(truth)(view).rgb)).save(path)
        views[i] = replace(view, image=str(path))
    protocol = choose_protocol(views, Split(test_every=8 if with_test_view else 0), TRAIN)
    evaluation = evaluate_views(
        scene, protocol, Evaluate(lpips_net="none"), TRAIN, folder / "renders", threads=threads
    )
    found = measure_coverage(
        folder,
        scene,
        views,
        protocol,
        protocol.options(TRAIN, threads),
        evaluation,
        folder / "renders",
        WorldFrame(UP, None),
    )
    assert CoverageRecord.read(folder) == found
    return found


@pytest.fixture(autouse=True)
def fixed_seed() -> None:
    torch.manual_seed(0)


def test_low_trust_means_high_error_and_all_named_images_exist(tmp_path) -> None:
    found = measured(tmp_path / "a")
    (view,) = found.views
    assert view.name == "right.png" and 0.1 < view.low_trust_share < 0.95
    assert found.error is not None and found.surface is not None
    assert found.error.by_trust[0].rmse > 2 * found.error.by_trust[-1].rmse
    assert found.surface.seen_by.three_or_more > 0.3
    assert 1 <= len(found.viewpoints) <= 5
    # The best viewpoint is at the right end of the cameras.
    assert found.viewpoints[0].position[0] > 0.5
    for entry in (view, *found.viewpoints):
        for name in (entry.render, entry.trust_map):
            with Image.open(tmp_path / "a" / name) as picture:
                assert picture.size == (60, 60)
    pose = np.array(found.viewpoints[0].world_to_camera)
    place = -pose[:3, :3].T @ pose[:3, 3]
    assert place == pytest.approx(found.viewpoints[0].position, abs=1e-5)


def test_output_is_independent_of_threads(tmp_path) -> None:
    def files(folder: Path) -> dict[str, bytes]:
        chosen = [folder / "coverage.json", *(folder / "coverage").iterdir()]
        return {str(f.relative_to(folder)): f.read_bytes() for f in chosen}

    measured(tmp_path / "a", threads=1)
    torch.manual_seed(0)
    measured(tmp_path / "b", threads=3)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_without_test_views_no_error_is_reported(tmp_path) -> None:
    found = measured(tmp_path / "a", with_test_view=False)
    assert found.views == () and found.error is not None
    assert found.error.rank_correlation is None and found.error.by_trust == ()
    assert found.viewpoints


def test_rank_correlation_gives_equal_values_their_mean_rank() -> None:
    rising = np.array([1.0, 2.0, 3.0, 4.0])
    assert spearman(rising, np.array([10.0, 30.0, 20.0, 40.0])) == pytest.approx(0.8)
    tied = np.array([1.0, 2.0, 2.0, 5.0])
    assert spearman(tied, -tied) == pytest.approx(-1)
    # Pearson's correlation of the ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4.
    assert spearman(tied, rising) == pytest.approx(4.5 / np.sqrt(4.5 * 5))
