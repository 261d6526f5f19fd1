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
    "crop": """
>>> import octasplat as osp
>>> cropped = osp.crop("scene.ply", "half.ply", where="z < 0")
>>> cropped.kept, cropped.count
(600, 1200)
""",
}
