"""
Make ``refdata/files/psf/jwst_pupil.toml`` from the stpsf wheel.

The outlines of the mirror segments and of the struts, the interpixel capacitance of the
MIRI detector and the amplitudes of its cruciform stand as literals in stpsf's source
(BSD-3). They are read from the wheel without importing it::

    pip download --no-deps stpsf==2.2.0 -d wheels
    python tools/make_pupil.py wheels/stpsf-2.2.0-py3-none-any.whl
"""

import argparse
import ast
import hashlib
import zipfile
from pathlib import Path

OUTPUT = Path(__file__).parents[1] / "miricigale/refdata/files/psf/jwst_pupil.toml"


def literal(node):
    """Evaluate a literal in which ``np.array(x)`` stands for ``x``."""
    if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "array":
        return literal(node.args[0])
    if isinstance(node, (ast.Tuple, ast.List)):
        return [literal(item) for item in node.elts]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        return literal(node.left) / literal(node.right)
    return ast.literal_eval(node)


def assignments(source, names):
    """Collect the literals assigned to ``names`` anywhere in a module."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name in names and name not in found:
                if isinstance(node.value, ast.Dict):
                    found[name] = {
                        literal(k): literal(v)
                        for k, v in zip(node.value.keys, node.value.values, strict=True)
                    }
                else:
                    found[name] = literal(node.value)
    missing = set(names) - set(found)
    if missing:
        msg = f"the wheel does not assign {sorted(missing)}"
        raise SystemExit(msg)
    return found


def polygon_lines(title, polygons):
    """TOML lines of a table of polygons (metres)."""
    lines = ["", f"[{title}]"]
    for name, vertices in polygons:
        points = ", ".join(f"[{x:.9g}, {y:.9g}]" for x, y in vertices)
        lines.append(f'"{name}" = [{points}]')
    return lines


def main():
    """Read the wheel and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("wheel", type=Path)
    wheel = parser.parse_args().wheel
    with zipfile.ZipFile(wheel) as archive:
        constants = archive.read("stpsf/constants.py").decode()
        detectors = archive.read("stpsf/detectors.py").decode()
    c = assignments(
        constants,
        {
            "JWST_PRIMARY_SEGMENTS",
            "JWST_PRIMARY_STRUTS",
            "JWST_CIRCUMSCRIBED_DIAMETER",
            "INSTRUMENT_IPC_DEFAULT_KERNEL_PARAMETERS",
            "MIRI_CRUCIFORM_INNER_RADIUS_PIX",
            "JWST_TYPICAL_LOS_JITTER_PER_AXIS",
        },
    )
    d = assignments(detectors, {"kernel_amp_dict", "kernel_amp_corrections"})
    lines = [
        f"# Made by tools/make_pupil.py from {wheel.name} (BSD-3, STScI); do not edit.",
        "# Outlines in metres in the entrance pupil: x along V2, y along V3, seen from the front.",
        f"diameter = {c['JWST_CIRCUMSCRIBED_DIAMETER']}  # m, outer corners of the B segments",
        f"jitter = {c['JWST_TYPICAL_LOS_JITTER_PER_AXIS']}  # arcsec, 1 sigma per axis",
        "# couplings to the pixels along x, along y and on the diagonal",
        f"ipc = {c['INSTRUMENT_IPC_DEFAULT_KERNEL_PARAMETERS']['MIRI']}",
        f"cruciform_inner_radius = {c['MIRI_CRUCIFORM_INNER_RADIUS_PIX']}  # pixels",
        "",
        "# amplitude of the exponential cross: stpsf's kernel at an oversampling of 4, times its",
        "# correction for the flight-model PSFs, times its factor 0.5 for cycle 1",
        "[cruciform]",
    ]
    for name, amplitude in d["kernel_amp_dict"].items():
        value = amplitude * d["kernel_amp_corrections"].get(name, 2.0) * 0.5
        if name.endswith("W") and value > 0:
            lines.append(f'"miri.{name.lower()}" = {value:.6g}')
    lines += polygon_lines("segments", c["JWST_PRIMARY_SEGMENTS"])
    lines += polygon_lines("struts", c["JWST_PRIMARY_STRUTS"])
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text("\n".join(lines) + "\n")
    print(f"{OUTPUT}\nsha256 {hashlib.sha256(OUTPUT.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main()
