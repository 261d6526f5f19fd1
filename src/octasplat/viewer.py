"""A scene in a browser of this machine: the viewer of the service's page, without the service."""

import tempfile
import weakref
import webbrowser
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.materials import has_materials
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.runs.run_folder import BLOCKS, CONFIG, SCENE, is_run, run_viewpoints
from octasplat.notebook import log_event
from octasplat.paths import PathLike
from octasplat.runs import Run
from octasplat.scenes import Scene, read_scene
from octasplat.service.web.cameras import read_view_poses, viewer_cameras
from octasplat.service.web.scene_server import SceneServer, ViewedScene

if TYPE_CHECKING:
    from octasplat.engine.shading.deferred import DeferredShading

Shading = Literal["materials", "harmonics"]


class Viewer:
    """A page with a 3D view, served as long as this process runs or until it is closed.

    >>> import octasplat as osp
    >>> with osp.view("scene.ply", open_browser=False) as viewer:
    ...     viewer.url.startswith("http://127.0.0.1:")
    True
    """

    def __init__(self, server: SceneServer, folder: "tempfile.TemporaryDirectory[str]") -> None:
        """Take over a running server; :func:`view` starts one."""
        self._server = server
        self._end = weakref.finalize(self, _close_server, server, folder)

    @property
    def url(self) -> str:
        """Return the address of the page, for browsers of this machine."""
        return self._server.url

    def close(self) -> None:
        """Stop the server; an open page keeps what it has loaded."""
        self._end()

    def wait(self) -> None:
        """Wait until the viewer is closed, or for Ctrl-C; for the end of a script."""
        self._server.wait()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Viewer({self.url!r})"

    def _repr_html_(self) -> str:
        return f'<a href="{self.url}" target="_blank">Open the scene at {self.url}</a>'


def view(
    source: Scene | PathLike,
    *,
    open_browser: bool = True,
    port: int = 0,
    background: str = "black",
    shading: Shading | None = None,
) -> Viewer:
    """Show a scene in a browser, and return the viewer, which is to be kept.

    The page draws the octagons as the tracer sees them and comes from this process alone, under a random
    address that only browsers of this machine reach. Of a run, one can go from photograph to photograph.

    Args:
        source: a scene, a file of any format, or a run; of a run in blocks that is not done yet, what its
            blocks have learnt so far.
        open_browser: open the page; else its address is all.
        port: where to serve it; 0 takes a free one.
        background: ``black`` or ``white``, to begin with.
        shading: ``materials`` in the light that a run has learnt, or ``harmonics``, to begin with; by default
            materials, of a run that has them.

    Raises:
        OctasplatError: the source cannot be read, or the port or the background is none, or materials are
            asked for of a scene without.

    >>> import octasplat as osp
    >>> viewer = osp.view(osp.load("scene.ply"), open_browser=False)
    >>> viewer.close()
    """
    scene = source if isinstance(source, Scene) else read_shown_scene(Path(source), log_event)
    path = None if isinstance(source, Scene) else Path(source)
    viewer = serve_scene(scene, path, port=port, background=background, shading=shading)
    if open_browser:
        webbrowser.open(viewer.url)
    return viewer


def read_shown_scene(path: Path, progress: EventListener) -> Scene:
    """Return the scene of a file or run, or what the blocks of an unfinished run have learnt so far.

    Raises:
        SceneFileError: the file cannot be read.
        ConfigError: a run's light cannot be read.
        CheckpointError: what blocks have learnt cannot be read.
    """
    if (path / BLOCKS).is_dir() and not (path / SCENE).exists():
        from octasplat.engine.blocks.scene_so_far import scene_so_far

        if (found := scene_so_far(path)) is not None:
            return Scene(found)
    return read_scene(path, progress)


def serve_scene(
    scene: Scene, path: Path | None, *, port: int, background: str, shading: Shading | None = None
) -> Viewer:
    """Return the viewer of a scene, without opening a browser.

    Args:
        scene: what is shown.
        path: where it was read from, which names the page and, of a run, has the cameras; None if nowhere.
        port: where to serve it; 0 takes a free one.
        background: ``black`` or ``white``, to begin with.
        shading: ``materials`` or ``harmonics``, to begin with; None takes materials where their light is
            known.

    Raises:
        ConfigError: the port or the background is none, or materials cannot be shown.
    """
    if background not in ("black", "white"):
        raise ConfigError(f"background: {background!r} is neither 'black' nor 'white'.")
    if not 0 <= port <= 65535:
        raise ConfigError(f"port: {port} is none; the highest is 65535, and 0 takes a free one.")
    lit_by = _shown_light(scene, shading)
    run = path if path is not None and is_run(path) and (path / CONFIG).exists() else None
    folder = tempfile.TemporaryDirectory(prefix="octasplat-view-")
    try:
        ply = Path(folder.name) / "scene.ply"
        write_gaussian_ply(scene.gaussians, ply, facts=scene.facts)
        name = "Scene" if path is None else path.resolve().name
        q = None if run is None else float(Run(run).settings["train"]["trace"]["q"])
        cameras = {"views": []} if run is None else _run_cameras(run)
        viewed = ViewedScene(name, ply, cameras, q, background)
        if lit_by is not None:
            light = Path(folder.name) / "light.hdr"
            write_environment(light, lit_by.light.radiance_linear)
            viewed = replace(viewed, light=light, light_up=lit_by.settings.up_world)
        try:
            server = SceneServer(viewed, port)
        except OSError as error:
            raise ConfigError(f"port {port} cannot be used ({error.strerror}); choose another.") from error
        return Viewer(server, folder)
    except BaseException:
        folder.cleanup()
        raise


def _shown_light(scene: Scene, shading: Shading | None) -> "DeferredShading | None":
    """Return the shading whose light materials are shown in; None for harmonics.

    Raises:
        ConfigError: materials are asked for, and their light is not known, or does not show them.
    """
    if shading not in (None, "materials", "harmonics"):
        raise ConfigError(f"shading: {shading!r} is neither 'materials' nor 'harmonics'.")
    if shading == "harmonics":
        return None
    found = scene.materials if has_materials(scene.gaussians) else None
    if found is None:
        why = "holds no light that materials were learnt in"
    elif found.albedo_holds_light:
        why = "has base colors with the light of the photographs, which light from far away cannot show"
    elif found.matt_color_is_harmonics:
        why = "has the color of what is matt from the harmonics, which no light of the page changes"
    else:
        return found
    if shading == "materials":
        raise ConfigError(f"shading: the scene {why}; leave it out to see harmonics.")
    return None


def _run_cameras(run: Path) -> Mapping[str, Any]:
    """Return where the photographs of a run were taken, for the page."""
    viewpoints = run_viewpoints(run)
    content = {
        "cameras": [
            {
                "model": camera.model,
                "params": camera.params,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
            }
            for camera in viewpoints.cameras
        ],
        "views": [
            {
                "name": shot.name,
                "camera": shot.camera_index,
                "rotation_cam_from_world": shot.rotation_cam_from_world,
                "translation_cam_from_world": shot.translation_cam_from_world,
            }
            for shot in viewpoints.views
        ],
    }
    held_out = [viewpoints.views[number].name for number in viewpoints.test_indices.tolist()]
    poses = read_view_poses(content)
    return viewer_cameras(poses, held_out) if poses else {"views": []}


def _close_server(server: SceneServer, folder: "tempfile.TemporaryDirectory[str]") -> None:
    server.close()
    folder.cleanup()
