"""Soft bodies and cloths that fall, by MuJoCo."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from soft_body import Lattice

STEP_SECONDS = 0.002
DENSITY = 300.0
"""Mass per cubic world unit; foam rubber where units are metres."""
CLOTH_DENSITY = 0.4
"""Mass per square world unit; a heavy cotton."""
CLOTH_RADIUS = 0.012
"""How far off things the middle of the cloth is held."""
CLOTH_THICKNESS = 0.004


def simulate(
    lattice: Lattice,
    world: Path,
    *,
    move: tuple[float, float, float],
    seconds: float,
    fps: float,
    young: float,
) -> Float64[np.ndarray, "f v 3"]:
    """Positions of the lattice's nodes, frame by frame, after it is let go.

    Args:
        lattice: the body at rest.
        world: an MJCF file with what it falls on, z up.
        move: shift of the body before it is let go, world units.
        seconds: duration.
        fps: frames a second.
        young: Young's modulus; the body's density is ``DENSITY``.
    """
    points = " ".join(f"{value:.6g}" for value in (lattice.nodes_world + move).reshape(-1))
    tetrahedra = " ".join(str(node) for node in lattice.tetrahedra.reshape(-1))
    flex = (
        f'<flexcomp name="body" type="direct" dim="3" mass="{DENSITY * lattice.volume:.6g}" '
        f'radius="{0.2 * lattice.cell_side:.6g}" point="{points}" element="{tetrahedra}">'
        f'<contact selfcollide="none" friction="0.9" solref="0.01 1"/>'
        f'<elasticity young="{young:.6g}" poisson="0.3" damping="0.004"/></flexcomp>'
    )
    return _let_go(flex, lattice.nodes_world + move, world, seconds, fps)


def simulate_cloth(
    vertices_world: Float64[np.ndarray, "v 3"],
    triangles: Int64[np.ndarray, "t 3"],
    world: Path,
    *,
    seconds: float,
    fps: float,
    young: float,
) -> Float64[np.ndarray, "f v 3"]:
    """Positions of a cloth's vertices, frame by frame, after it is let go; arguments as for `simulate`."""
    points = " ".join(f"{value:.6g}" for value in vertices_world.reshape(-1))
    elements = " ".join(str(node) for node in triangles.reshape(-1))
    corners = vertices_world[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    flex = (
        f'<flexcomp name="cloth" type="direct" dim="2" mass="{CLOTH_DENSITY * area.sum() / 2:.6g}" '
        f'radius="{CLOTH_RADIUS}" point="{points}" element="{elements}">'
        f'<contact selfcollide="none" friction="0.6" solref="0.01 1"/>'
        f'<elasticity young="{young:.6g}" poisson="0.2" thickness="{CLOTH_THICKNESS}" damping="0.002" '
        f'elastic2d="both"/></flexcomp>'
    )
    return _let_go(flex, vertices_world, world, seconds, fps)


def _let_go(
    flex: str, start_world: Float64[np.ndarray, "v 3"], world: Path, seconds: float, fps: float
) -> Float64[np.ndarray, "f v 3"]:
    import mujoco

    scene = world.read_text(encoding="utf-8").replace("</worldbody>", f"{flex}</worldbody>")
    model = mujoco.MjModel.from_xml_string(scene)
    model.opt.timestep = STEP_SECONDS
    data = mujoco.MjData(model)
    frames = [start_world]
    for frame in range(1, round(seconds * fps)):
        while data.time < frame / fps:
            mujoco.mj_step(model, data)
        frames.append(np.array(data.flexvert_xpos, np.float64))
    result = np.stack(frames)
    if not np.isfinite(result).all():
        raise RuntimeError("The simulation blew up; make the body softer or its cells larger.")
    return result
