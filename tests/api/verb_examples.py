"""The example of each verb's docstring; the tests run them in a folder with ``scene.ply`` and ``run``."""

EXAMPLES = {
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
}
