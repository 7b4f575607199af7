"""A scene's own split into training and test views, as its pose files list it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from pipeline.io.names import compare_names
from pipeline.io.poses.frames import ListedSplit

Part = Literal["train", "test"]


def listed_split(
    splits: Mapping[str, ListedSplit], photos: Sequence[str], warnings: list[str]
) -> dict[str, Part | None]:
    """Photograph -> its part of the split; None for photographs in neither part.

    Without a list of test views that exist, the validation views are the test views.

    Args:
        splits: name in the pose files -> list that it is in; empty without a split.
        photos: the photographs that have a pose, named as in the pose files.
        warnings: warnings are added to this list.

    Returns:
        Empty if the scene has no split with training and test views.
    """
    lists = {
        photo: splits.get(name) for photo, name in compare_names(list(splits), photos).names.items()
    }
    found = set(lists.values())
    test: ListedSplit = "test" if "test" in found else "val"
    if not {"train", test} <= found:
        if splits:
            missing = "no training view"
            if "train" in found:
                missing = "no test view beside the training views"
            warnings.append(
                f"the scene's own split is not used, because it lists {missing}: every n-th view "
                "is a test view (split.test_every)"
            )
        return {}
    parts: dict[ListedSplit | None, Part] = {"train": "train", test: "test"}
    result = {photo: parts.get(lists.get(photo)) for photo in photos}
    left_out = sorted(photo for photo, part in result.items() if part is None)
    if left_out:
        warnings.append(
            f"{len(left_out)} photographs are not used, because the scene's own split lists them "
            f"neither for training nor for the test (first: {left_out[0]}); split.source: every "
            "uses them"
        )
    return result
