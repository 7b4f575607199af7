"""More features for photographs that few pairs connect to each other.

Between distant viewpoints few of the strongest features are found in both photographs. More of them
give more verified pairs, and cost time: photographs that are connected well need none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.config import settled
from pipeline.config.schema import MAX_PHOTOS_WITH_MORE_FEATURES, MORE_FEATURES
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.manifest import Manifest
from pipeline.sfm.features import LOW_CONTRAST_THRESHOLD, extract_photos

#: A photograph with fewer pairs than this is weakly connected. Only pairs with enough inliers for
#: COLMAP's mapper to register the photograph by one of them (its default) are counted.
MIN_STRONG_PAIRS, STRONG_INLIERS = 3, 30
#: Largest share of weakly connected photographs without a second look.
MAX_WEAK_SHARE = 0.05


@dataclass(frozen=True)
class SecondLook:
    """How more features are extracted.

    Attributes:
        features: The options of the first look.
        cache: A folder for keypoints that may outlive the results.
        out: The folder for the keypoint files.
    """

    features: settled.Features
    cache: Path
    out: Path

    def is_needed(self, names: Sequence[str], verified: Mapping[tuple[str, str], int]) -> bool:
        """Whether few strong pairs connect many of the photographs to the others, unless the first
        look may have found as many features or the scene is large.

        Args:
            names: The names of all photographs.
            verified: The names of two photographs -> number of verified matches.
        """
        if (
            self.features.max_features >= MORE_FEATURES
            or len(names) > MAX_PHOTOS_WITH_MORE_FEATURES
        ):
            return False
        count = Counter(
            name for pair, inliers in verified.items() if inliers >= STRONG_INLIERS for name in pair
        )
        weak = sum(count[name] < min(MIN_STRONG_PAIRS, len(names) - 1) for name in names)
        return weak > MAX_WEAK_SHARE * len(names)

    @staticmethod
    def decision(before: int, after: int) -> str:
        """The sentence for the log, with the numbers of verified pairs before and after."""
        return (
            f"many photographs had fewer than {MIN_STRONG_PAIRS} pairs with {STRONG_INLIERS} "
            f"inliers: up to {MORE_FEATURES} features in each raise the verified pairs from "
            f"{before} to {after}"
        )


def extract_more(manifest: Manifest, look: SecondLook, threads: int) -> None:
    """Write the keypoint files of all photographs to ``look.out``: more features, also of lower
    contrast."""
    config = look.features.model_copy(update={"max_features": MORE_FEATURES})
    # pycolmap and OpenCV cannot share a process.
    run_isolated(
        extract_photos,
        *(manifest.photos, config, look.out),
        cache=look.cache,
        threads=threads,
        contrast_threshold=LOW_CONTRAST_THRESHOLD,
    )
