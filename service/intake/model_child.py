"""Child process that parses an untrusted COLMAP model.

    python -P -m octasplat.service.intake.model_child < request.json > answer.json

It gives up rights as :mod:`octasplat.service.intake.parser_child` says. Only ``check`` imports pycolmap. The
parent is :mod:`octasplat.service.intake.model_check`; the request and the answer are defined here.
"""

import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from octasplat.engine.core.portable_names import FileNameError, check_name, quoted_name
from octasplat.service.intake.faults import IntakeFault
from octasplat.service.intake.parser_child import ParserRequest, answer_request

if TYPE_CHECKING:
    from octasplat.engine.dataset.colmap_model import ColmapModel

MAX_FAULTS = 100
_MAX_COORDINATE = 1e12
_UNIT_TOLERANCE = 1e-3


class ModelRequest(ParserRequest):
    """Request to the child process that parses COLMAP models; ``root`` holds the models.

    Attributes:
        files: names of the models' files in the dataset, by their paths below ``root``.
        sizes_px: width and height of every photograph, by its name below ``images/``.
        min_views: fewer posed photographs do not make a scene.
    """

    files: dict[str, str]
    sizes_px: dict[str, tuple[int, int]]
    min_views: int


class ModelAnswer(BaseModel):
    """Response of the child process: faults, or else the content of the model."""

    faults: list[IntakeFault] = []
    views: int = 0
    cameras: int = 0
    camera_models: list[str] = []
    points: int = 0
    warnings: list[str] = []


def main() -> None:
    """Read the request from stdin, parse the model, and write the answer to stdout."""
    answer_request(ModelRequest, _check_within_memory)


def _check_within_memory(request: ModelRequest) -> ModelAnswer:
    try:
        return check(request)
    except MemoryError:
        return _fault_answer("model-memory", "The COLMAP model takes too much memory to read.")


def check(request: ModelRequest) -> ModelAnswer:
    """Parse the model and list all its faults."""
    from octasplat.engine.core.errors import DatasetError
    from octasplat.engine.dataset.colmap_model import colmap_model_of
    from octasplat.engine.dataset.colmap_reading import load_model
    from octasplat.engine.dataset.model_sources import find_model

    checker = _ModelChecker(request)
    try:
        folder = find_model(request.root)
        # Faults name files of the model that was chosen, of which there may be several.
        own = {
            Path(path).name: name
            for path, name in request.files.items()
            if (request.root / path).parent == (folder if folder.is_dir() else folder.parent)
        }
        checker.request = request = request.model_copy(update={"files": own})
        loaded = load_model(folder, request.sizes_px)
        checker.check_images(loaded.reconstruction)
        checker.check_cameras(loaded.reconstruction)
        if checker.faults:
            return ModelAnswer(faults=checker.faults)
        model = colmap_model_of(loaded, folder)
    except DatasetError as error:
        return _fault_answer(
            "model-damaged", request.without_root(str(error)), _file_in_sentence(str(error), request)
        )
    return checker.summary(model)


class _ModelChecker:
    """Collects a bounded number of faults."""

    def __init__(self, request: ModelRequest) -> None:
        self.request = request
        self.faults: list[IntakeFault] = []
        self._files: Mapping[str, str] = {}
        self._sizes = {unicodedata.normalize("NFC", name): size for name, size in request.sizes_px.items()}

    def _add_fault(self, model_file: str, code: str, detail: str) -> None:
        if len(self.faults) < MAX_FAULTS:
            self.faults.append(IntakeFault(code, detail, _model_file(model_file, self.request)))

    def check_images(self, reconstruction: Any) -> None:
        """Check the images' names against the photographs, and their poses."""
        import numpy as np

        from octasplat.engine.dataset.image_names import match_image_names

        known: set[str] = set()
        posed = 0
        names = [_image_name(image) for image in reconstruction.images.values()]
        self._files = match_image_names([name for name in names if name is not None], self._sizes.keys())
        for image_id, image in sorted(reconstruction.images.items()):
            name = _image_name(image)
            try:
                if name is None:
                    raise FileNameError("name-not-text", f"The name of image {image_id} is not UTF-8.")
                check_name(self._files.get(name, name))
            except FileNameError as error:
                self._add_fault("images", error.code, f"The COLMAP model names an image so: {error}")
                continue
            if not image.has_pose:
                continue
            quoted = quoted_name(name)
            posed += 1
            key = unicodedata.normalize("NFC", name)
            if key in known:
                self._add_fault(
                    "images", "model-image-twice", f"The COLMAP model has the image {quoted} twice."
                )
            known.add(key)
            if name not in self._files:
                self._add_fault(
                    "images",
                    "model-image-missing",
                    f"The image {quoted} of the COLMAP model is not among the photographs in images/; "
                    "upload it or run COLMAP without it.",
                )
            pose = image.cam_from_world()
            quat, translation = np.array(pose.rotation.quat), np.array(pose.translation)
            # A quaternion of zeros would pass for the identity further on.
            if not (np.isfinite(quat).all() and abs(float(np.linalg.norm(quat)) - 1.0) <= _UNIT_TOLERANCE):
                self._add_fault("images", "model-pose", f"The rotation of {quoted} is not a unit quaternion.")
            if not (np.isfinite(translation).all() and (abs(translation) < _MAX_COORDINATE).all()):
                self._add_fault(
                    "images", "model-pose", f"The translation of {quoted} is not a usable number."
                )
        if posed < self.request.min_views:
            self._add_fault(
                "images",
                "model-too-few-views",
                f"The COLMAP model has {posed} posed images; at least {self.request.min_views} are needed.",
            )

    def check_cameras(self, reconstruction: Any) -> None:
        """Check parameters of cameras, and their sizes against those of the photographs."""
        import numpy as np

        bad: set[int] = set()
        for camera_id, camera in sorted(reconstruction.cameras.items()):
            params = np.array(camera.params, dtype=np.float64)
            facts = f"{camera.model_name}, {camera.width}x{camera.height}, {params.tolist()}"
            problem = ""
            if not (params.size and camera.verify_params() and np.isfinite(params).all()):
                problem = "has parameters that are no usable numbers"
            elif not (params[list(camera.focal_length_idxs())] > 0).all():
                problem = "has a focal length that is not positive"
            elif camera.width < 1 or camera.height < 1:
                problem = "has no size"
            if problem:
                bad.add(int(camera_id))
                self._add_fault("cameras", "model-camera", f"Camera {camera_id} {problem} ({facts[:200]}).")
        for _, image in sorted(reconstruction.images.items()):
            name = _image_name(image)
            size = None if name is None else self._sizes.get(self._files.get(name, name))
            if name is None or size is None or not image.has_pose or int(image.camera_id) in bad:
                continue
            camera = reconstruction.cameras[image.camera_id]
            if not has_same_aspect((int(camera.width), int(camera.height)), size):
                self._add_fault(
                    "cameras",
                    "model-size",
                    f"{quoted_name(name)} is {size[0]}x{size[1]} but its camera {image.camera_id} "
                    f"is {camera.width}x{camera.height}; use the photographs COLMAP was given.",
                )

    def summary(self, model: "ColmapModel") -> ModelAnswer:
        """Return the answer for a model without faults."""
        posed = {unicodedata.normalize("NFC", image.name) for image in model.images}
        warnings = [self.request.without_root(warning) for warning in model.warnings]
        unposed = len(self._sizes) - len(posed)
        if unposed:
            warnings.append(f"{unposed} photographs have no pose in the COLMAP model and are left out.")
        return ModelAnswer(
            views=len(model.images),
            cameras=len(model.cameras),
            camera_models=sorted({camera.model for camera in model.cameras.values()}),
            points=len(model.points),
            warnings=warnings[:MAX_FAULTS],
        )


def _image_name(image: Any) -> str | None:
    """Return the name of an image, or None where it is no text."""
    try:
        return str(image.name)
    except UnicodeDecodeError:
        return None


def has_same_aspect(camera_px: tuple[int, int], image_px: tuple[int, int]) -> bool:
    """Return whether an image has the camera's aspect ratio to within a pixel, as the engine requires."""
    expected_height = camera_px[1] * image_px[0] / camera_px[0]
    expected_width = camera_px[0] * image_px[1] / camera_px[1]
    return min(abs(expected_height - image_px[1]), abs(expected_width - image_px[0])) <= 1


def _fault_answer(code: str, detail: str, file: str | None = None) -> ModelAnswer:
    return ModelAnswer(faults=[IntakeFault(code, detail, file)])


def _model_file(stem: str, request: ModelRequest) -> str | None:
    return request.files.get(f"{stem}.bin") or request.files.get(f"{stem}.txt")


def _file_in_sentence(sentence: str, request: ModelRequest) -> str | None:
    return next((name for name in request.files.values() if name in sentence), None)


if __name__ == "__main__":
    main()
