"""Photographs of the demo scene in other conditions: each option changes what it says, and the
truth stays exact."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.demo.cameras import lens, orbit
from pipeline.demo.capture import STOPS, TEST_EVERY, Conditions, Shot, photographed, shots, withheld
from pipeline.demo.render import rays
from pipeline.demo.scene import OBJECTS, distance, trace
from pipeline.demo.walkers import COVERED, walkers
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.io.colmap import read_model
from pipeline.photos.load import load_rgb
from pipeline.runtime.errors import UserError
from tests.plan.scans import look

VIEWS = 10
SPEC = DemoSpec(
    views=VIEWS, width=48, height=36, format="png", distortion="none", poses="colmap", seed=3
)
EVERYTHING = Conditions(
    lights=3, exposures=3, lenses=2, ramp=0.8, walkers=0.5, withhold=0.2, tests="clean"
)
# The first view of SPEC at these rows and columns.
AT = [(3, 5), (9, 40), (18, 24), (25, 10), (33, 33)]
PIXELS = [(140, 143, 138), (108, 126, 132), (107, 70, 70), (79, 100, 113), (112, 123, 95)]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("plain") / "s", Conditions())


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("all") / "s", EVERYTHING)


def write(folder: Path, conditions: Conditions) -> Path:
    write_demo(folder, replace(SPEC, conditions=conditions))
    return folder


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {path.name: load_rgb(path).astype(int) for path in sorted(folder.iterdir())}


def test_the_default_scene_has_the_colours_of_earlier_versions(plain: Path) -> None:
    """Records and expectations of the demo scene stay comparable."""
    picture = pictures(plain / "images")["view_000.png"]
    rows, columns = np.array(AT).T
    np.testing.assert_allclose(picture[rows, columns], PIXELS, atol=1)


def test_truth_does_not_depend_on_the_conditions(plain: Path, everything: Path) -> None:
    arc = withheld(EVERYTHING, VIEWS, SPEC.seed)
    assert len(arc) == 2
    truth = read_model(plain / "sparse_gt").by_name()
    for where, count in ((everything, 8), (everything / "withheld", 2)):
        model = read_model(where / "sparse_gt").by_name()
        assert {*model} == {*pictures(where / "images")} and len(model) == count
        for name, posed in model.items():
            np.testing.assert_array_equal(posed.world_to_camera, truth[name].world_to_camera)
            depth = f"depth_gt/{Path(name).stem}.npy"
            assert (where / depth).read_bytes() == (plain / depth).read_bytes()
    recorded = json.loads((everything / "demo.json").read_text())
    assert recorded["conditions"] == asdict(EVERYTHING)
    points = read_model(everything / "sparse" / "0").points
    assert np.abs(distance(points.xyz.T)).max() < 1e-3  # none on a walking figure


def test_clean_test_views_and_withheld_views_are_those_of_the_plain_scene(
    plain: Path, everything: Path
) -> None:
    reference, kept = pictures(plain / "images"), pictures(everything / "images")
    for name, picture in pictures(everything / "withheld" / "images").items():
        np.testing.assert_array_equal(picture, reference[name])
    for number, (name, picture) in enumerate(kept.items()):
        same = np.array_equal(picture, reference[name])
        assert same == (number % TEST_EVERY == 0)


def test_the_plan_uses_the_photographs_and_names_no_file_as_unused(everything: Path) -> None:
    found = look(everything)
    assert found.unused == () and len(found.photos) == 8


@pytest.mark.parametrize(
    "conditions",
    [Conditions(lights=2), Conditions(exposures=2), Conditions(lenses=2), Conditions(ramp=1.0)],
    ids=["lights", "exposures", "lenses", "ramp"],
)
def test_an_option_changes_only_what_it_names(conditions: Conditions) -> None:
    """The shots of two options together are the shots of each."""
    together = Conditions(lights=2, exposures=2, lenses=2, ramp=1.0)
    alone, all_of_them = (shots(c, 12, seed=1) for c in (conditions, together))
    changed = {
        name
        for shot in alone
        for name, value in asdict(shot).items()
        if value != asdict(Shot())[name]
    }
    expected = {
        "lights": {"lit"},
        "exposures": {"stops", "balance", "records_exposure"},
        "lenses": {"body", "falloff", "records_exposure"},
        "ramp": {"ramp"},
    }
    [option] = [n for n, v in asdict(conditions).items() if v != asdict(Conditions())[n]]
    assert changed == expected[option]
    for one, every in zip(alone, all_of_them, strict=True):
        for name in changed:
            assert getattr(one, name) == getattr(every, name)


def test_conditions_have_equal_shares_of_the_photographs() -> None:
    found = shots(Conditions(lights=4, exposures=3, lenses=2), 24, seed=0)
    for values in (
        [shot.lit for shot in found],
        [shot.stops for shot in found],
        [shot.body for shot in found],
    ):
        counts = [values.count(value) for value in {*values}]
        assert len(set(counts)) == 1 and len(counts) > 1
    assert {shot.stops for shot in found} == set(STOPS[:3])


def test_exposure_vignetting_and_ramp_in_stops() -> None:
    camera = lens("none", 40, 30)
    flat = np.full((30, 40, 3), 0.2)

    def stops(shot: Shot) -> np.ndarray:
        return np.log2(photographed(flat, shot, camera) / 0.2)

    np.testing.assert_allclose(stops(Shot(stops=-0.7)), -0.7)
    assert np.array_equal(photographed(flat, Shot(), camera), flat)
    vignetted = stops(Shot(falloff=1.0))[..., 0]
    assert vignetted[0, 0] == pytest.approx(-1, abs=0.1)
    assert vignetted[15, 20] == pytest.approx(0, abs=0.01) and vignetted.argmin() == 0
    ramp = stops(Shot(ramp=(0.5, -0.3)))[..., 0]
    assert ramp[:, -1] - ramp[:, 0] == pytest.approx(0.5 * 39 / 40)
    assert ramp[-1] - ramp[0] == pytest.approx(-0.3 * 29 / 30)
    balanced = stops(Shot(balance=(1.1, 1.0, 0.9)))
    np.testing.assert_allclose(balanced[0, 0], np.log2([1.1, 1.0, 0.9]))


def test_exif_names_the_body_and_the_exposure(tmp_path: Path, plain: Path) -> None:
    conditions = Conditions(exposures=3, lenses=2)
    write_demo(tmp_path / "s", replace(SPEC, views=6, conditions=conditions))
    bodies = set()
    for shot, path in zip(
        shots(conditions, 6, SPEC.seed), sorted((tmp_path / "s/images").iterdir()), strict=True
    ):
        exif = Image.open(path).getexif()
        photo = exif.get_ifd(0x8769)
        bodies.add(exif[272])
        assert np.log2(float(photo[33434]) * 60) == pytest.approx(shot.stops, abs=0.01)
        assert (float(photo[33437]), photo[34855]) == (5.6, 100)
    assert bodies == {"Demo 2", "Demo 3"}
    assert 33434 not in Image.open(plain / "images/view_000.png").getexif().get_ifd(0x8769)


def test_walkers_stand_on_the_floor_and_cover_a_part_of_the_photograph() -> None:
    camera = lens("none", 120, 90)
    through = rays(camera)
    for number, posed in enumerate(orbit([str(i) for i in range(6)], seed=1)):
        figures = walkers(posed, through, 1, number)
        assert figures == walkers(posed, through, 1, number)
        right, down, forward = (row[:, None] for row in posed.rotation)
        x, y, z = through.centres.reshape(3, -1)
        towards = right * x + down * y + forward * z
        _, index = trace(posed.centre[:, None], towards, (*OBJECTS, *figures))
        share = (index >= len(OBJECTS)).mean()
        assert COVERED[0] - 0.02 < share < COVERED[1] + 0.02
        lowest = min(getattr(figure.shape, "bottom", np.inf) for figure in figures)
        assert lowest == 0


def test_walkers_are_in_their_share_of_the_training_photographs(tmp_path: Path) -> None:
    found = shots(Conditions(walkers=0.5), 16, seed=2)
    walked = [number for number, shot in enumerate(found) if shot.walkers]
    assert len(walked) == 7 and not {*walked} & {0, 8}


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (replace(SPEC, conditions=Conditions(lights=0)), "1 or more lights"),
        (replace(SPEC, conditions=Conditions(walkers=1.5)), "shares between 0 and 1"),
        (replace(SPEC, masks=True, conditions=Conditions(lights=2)), "without alpha, masks"),
        (replace(SPEC, format="dng", conditions=Conditions(ramp=1.0)), "without alpha, masks"),
    ],
)
def test_conditions_that_are_out_of_range(tmp_path: Path, spec: DemoSpec, message: str) -> None:
    with pytest.raises(UserError, match=message):
        write_demo(tmp_path / "s", spec)
