"""Photographs that mapping left out: a second try registers those that few matches determine, and
none that its pairs contradict or that match by chance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.runtime.isolate import run_isolated

#: Matches of the last photograph: enough for the second try, too few for the first.
FEW = 22
#: Right and wrong matches of each pair of the last photograph that is not verified.
RIGHT, WRONG = 4, 8


def map_twice(folder: Path, kind: str) -> dict[str, Any]:
    """Map a synthetic scene whose last photograph has few matches, with each of the others.

    Args:
        kind: "few"; "contradicted": the matches with all but two of the others are wrong;
            "unverified": no pair is, and a third of the matches is right; "chance": none is.
    """
    import numpy as np
    import pycolmap

    from pipeline.sfm.attempts import map_until_good
    from pipeline.sfm.left_out import register_left_out
    from pipeline.sfm.models import quiet_colmap

    quiet_colmap()
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=300
    )
    path = folder / "database.db"
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(
            pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), truth, database
        )
        last = max(truth.reg_image_ids())
        ids, geometries = database.read_two_view_geometries()
        points = sorted(truth.points3D)[:FEW]
        column = {
            element.point2D_idx
            for point in points
            for element in truth.point3D(point).track.elements
            if element.image_id == last
        }
        seen = 0
        for pair_id, geometry in zip(ids, geometries, strict=True):
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if last not in pair:
                continue
            side = pair.index(last)
            matches = geometry.inlier_matches
            if kind in ("unverified", "chance"):
                right = rng.permutation(matches)[: RIGHT if kind == "unverified" else 0]
                wrong = np.stack([rng.permutation(column)[:WRONG] for column in matches.T], axis=1)
                database.delete_two_view_geometry(*pair)
                database.delete_matches(*pair)
                database.write_matches(*pair, np.concatenate([right, wrong]))
                continue
            few = matches[[int(match[side]) in column for match in matches]]
            seen += 1
            if kind == "contradicted" and seen > 2:
                few[:, side] = rng.permutation(few[:, side])
            geometry.inlier_matches = few
            database.update_two_view_geometry(*pair, geometry)
    best, _ = map_until_good(path, "incremental", 8, 0.5, 0, 1)
    model = best.models[0]
    more, names = register_left_out(model, path, 0)
    again, _ = register_left_out(model, path, 0)
    same = [
        (np.asarray(model.image(i).cam_from_world().matrix()), more.image(i))
        for i in model.reg_image_ids()
    ]
    aligned = pycolmap.align_reconstructions_via_reprojections(more, truth)
    return {
        "first": model.num_reg_images(),
        "names": names,
        "last": truth.image(last).name,
        "registered": more.num_reg_images(),
        "moved": max(float(abs(a - b.cam_from_world().matrix()).max()) for a, b in same),
        "off": float(
            np.linalg.norm(
                aligned * more.image(last).projection_center()
                - truth.image(last).projection_center()
            )
        )
        if names
        else None,
        "repeated": [
            (
                again.image(i).cam_from_world().matrix() == more.image(i).cam_from_world().matrix()
            ).all()
            for i in more.reg_image_ids()
        ],
    }


@pytest.mark.parametrize("kind", ["few", "unverified"])
def test_few_matches_register_a_photograph_in_a_finished_model(tmp_path: Path, kind: str) -> None:
    found = run_isolated(map_twice, tmp_path, kind)
    assert found["first"] == 7 and found["registered"] == 8
    assert found["names"] == [found["last"]] and found["off"] < 0.02
    assert found["moved"] < 1e-9 and all(found["repeated"])


@pytest.mark.parametrize("kind", ["contradicted", "chance"])
def test_a_photograph_that_its_pairs_contradict_stays_out(tmp_path: Path, kind: str) -> None:
    found = run_isolated(map_twice, tmp_path, kind)
    assert found["first"] == found["registered"] == 7 and not found["names"]
