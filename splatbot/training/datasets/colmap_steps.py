"""Steps of COLMAP by pycolmap, with the commands of the program `colmap`, each in a process that can be ended.

The module runs as a program, and imports nothing of splatbot, so that a step starts quickly.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def main() -> None:
    """Run the step that the command line names."""
    import pycolmap

    parser = argparse.ArgumentParser()
    parser.add_argument("step", choices=["feature_extractor", "exhaustive_matcher", "sequential_matcher", "mapper"])
    parser.add_argument("--database_path", type=Path, required=True)
    parser.add_argument("--image_path", type=Path)
    parser.add_argument("--output_path", type=Path)
    parser.add_argument("--ImageReader.single_camera", type=int, dest="single_camera")
    given = parser.parse_args()
    match given.step:
        case "feature_extractor":
            mode = pycolmap.CameraMode.SINGLE if given.single_camera else pycolmap.CameraMode.AUTO
            pycolmap.extract_features(given.database_path, given.image_path, camera_mode=mode)
        case "exhaustive_matcher":
            pycolmap.match_exhaustive(given.database_path)
        case "sequential_matcher":
            pycolmap.match_sequential(given.database_path)
        case "mapper":
            pycolmap.incremental_mapping(given.database_path, given.image_path, given.output_path)


if __name__ == "__main__":
    main()
