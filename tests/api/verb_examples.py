"""The example of each verb's docstring; the tests run them in a folder with ``scene.ply`` and ``run``."""

EXAMPLES = {
    "estimate": """
>>> import octasplat as osp
>>> found = osp.estimate("photos", preset="fast", cores=8)
>>> found.cores, found.seconds > 0
(8, True)
""",
    "plan": """
>>> import octasplat as osp
>>> found = osp.plan("photos", blocks=2)
>>> len(found.blocks), found.seconds > 0
(2, True)
""",
    "evaluate": """
>>> import octasplat as osp
>>> found = osp.evaluate("run")
>>> found.psnr > 10, len(found.views)
(True, 2)
""",
    "material": """
>>> import octasplat as osp
>>> osp.material("shiny.ply", "dull.ply", where="metallic > 0.5", set={"roughness": 0.9}).changed
600
""",
    "surface": """
>>> import octasplat as osp
>>> osp.surface("run", "surface.glb", max_triangles=500).files[0].name
'surface.glb'
""",
    "render": """
>>> import octasplat as osp
>>> osp.render("run", "views/", views="all").images
9
>>> place = {"camera": (0, 0, -4), "look_at": (0, 0, 0)}
>>> osp.render("scene.ply", "one.png", **place, width_px=64, height_px=48).images
1
""",
    "relight": """
>>> import octasplat as osp
>>> osp.relight(
...     "shiny.ply", "relit/", environments=["studio.hdr"], frames=2, width_px=32, height_px=24
... ).images
2
""",
    "stage-init": """
>>> import octasplat as osp
>>> osp.stage_init("scene.ply", "stage.toml").files[0].name
'stage.toml'
""",
    "crop": """
>>> import octasplat as osp
>>> cropped = osp.crop("scene.ply", "half.ply", where="z < 0")
>>> cropped.kept, cropped.count
(600, 1200)
""",
    "export": """
>>> import octasplat as osp
>>> [path.name for path in osp.export("run", ["scene.glb", "scene.splat"]).files]
['scene.glb', 'scene.splat']
""",
    "import": """
>>> import octasplat as osp
>>> splats = osp.save(osp.load("scene.ply"), "foreign.splat")
>>> osp.import_(splats, "imported.ply").files[0].name
'imported.ply'
""",
    "edit": """
>>> import octasplat as osp
>>> len(osp.load(osp.edit("run", "edited.ply", meshes=["run/mesh.ply"]).files[0])) > 100
True
""",
    "deform": """
>>> import octasplat as osp
>>> osp.deform("scene.ply", "bent.ply", proxy="cage.obj", deformed=["bent.obj"]).moving
1200
""",
    "transform": """
>>> import octasplat as osp
>>> osp.transform("scene.ply", "moved.ply", translate=(0, 0, 1), scale=2).count
1200
>>> import numpy as np
>>> osp.transform("scene.ply", "mirrored.ply", matrix=np.diag([-1, 1, 1, 1])).matrix[0]
(-1.0, 0.0, 0.0, 0.0)
""",
    "merge": """
>>> import octasplat as osp
>>> osp.merge(["scene.ply", "shiny.ply"], "both.ply").counts
(1200, 1200)
""",
    "clean": """
>>> import octasplat as osp
>>> cleaned = osp.clean("scene.ply", "cleaned.ply", min_opacity=0.5, floaters=False)
>>> cleaned.count, cleaned.kept + cleaned.faint
(1200, 1200)
""",
    "simplify": """
>>> import octasplat as osp
>>> osp.simplify("scene.ply", "small.ply", count=300).kept, len(osp.load("small.ply"))
(300, 300)
""",
    "reconstruct": """
>>> import octasplat as osp
>>> def stop_early(step):
...     return step.iteration < 20
>>> small = {"preset": "fast", "iterations": 60, "max_gaussians": 300, "exports": ["mesh.ply"]}
>>> run = osp.reconstruct("photos", "out", **small, on_step=stop_early)
>>> run.is_finished
False
>>> run = osp.reconstruct("photos", "out", resume=True)
>>> run.is_finished, run.training["iterations"]
(True, 60)
""",
    "info": """
>>> import octasplat as osp
>>> osp.info("scene.ply").scene.count
1200
""",
}
