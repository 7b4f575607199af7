"""The camera path of the exported video, checked before any job starts."""

from __future__ import annotations

from pipeline.config.export import Export
from pipeline.io.camera_paths import read_camera_path
from pipeline.plan.scan import Scan
from pipeline.runtime.errors import UserError
from pipeline.runtime.suggest import did_you_mean, nearest


def check_video_path(scan: Scan, export: Export) -> None:
    """Check the file or the photographs of ``export.video.path``.

    Raises:
        UserError: The file cannot be read or is no camera path; or a photograph does not exist.
            Frames of videos get their names later.
    """
    if "video" not in export.formats:
        return
    if export.video.path_file is not None:
        read_camera_path(export.video.path_file)
    elif isinstance(export.video.path, tuple) and not scan.videos:
        names = {photo.name for photo in scan.manifest.photos}
        for name in export.video.path:
            if name not in names:
                raise UserError(
                    f"export.video.path: {name} is not a photograph of the scene"
                    f"{did_you_mean(nearest(name, names))}",
                    fix="choose among the names of the photographs, with their folders in images/",
                )
