"""Makes the ZIP file that Blender installs: python pack_addon.py octasplat_blender.zip."""

import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
FILES = ("addon/blender_manifest.toml", "addon/__init__.py", "import_octasplat.py", "export_camera_path.py")
DATE = (2020, 1, 1, 0, 0, 0)
"""Of all files within, so that the same add-on has the same bytes."""


def pack(target: Path) -> None:
    """Write the add-on with the scripts that it shares with the command line."""
    partial = target.with_name(target.name + ".partial")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in FILES:
            entry = zipfile.ZipInfo(Path(name).name, DATE)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, (HERE / name).read_bytes())
    partial.replace(target)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("Name the file to write, such as octasplat_blender.zip.")
    pack(Path(sys.argv[1]))
