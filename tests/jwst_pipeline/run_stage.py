"""
One stage of the official pipeline in a process of its own, which cannot open a connection.

``python run_stage.py STAGE OUTPUT FILE [FILE ...]``; ``detector1+ramp`` keeps the ramp that is fitted,
``image3+align`` aligns the images, and ``image3+level`` leaves their levels.
"""

import json
import resource
import socket
import sys
from pathlib import Path

attempts = []


def refuse(self, address):
    attempts.append(str(address))
    msg = f"the pipeline must not connect to {address}"
    raise OSError(msg)


def detector1(files, output, **options):
    from jwst.pipeline import Detector1Pipeline

    for path in files:
        Detector1Pipeline.call(path, save_results=True, output_dir=output, **options)


def image2(files, output):
    from jwst.pipeline import Image2Pipeline

    # no picture of each exposure, to save time
    steps = {"resample": {"skip": True}}
    for path in files:
        Image2Pipeline.call(path, save_results=True, output_dir=output, steps=steps)


def image3(files, output, *, align=False, level=True):
    from jwst.associations.asn_from_list import asn_from_list
    from jwst.associations.lib.rules_level3_base import DMS_Level3_Base
    from jwst.pipeline import Image3Pipeline

    association = asn_from_list(files, rule=DMS_Level3_Base, product_name="mosaic")
    path = Path(output, "asn.json")
    path.write_text(association.dump()[1])
    steps = {
        # the positions are to be those of the headers, where nothing else is asked for
        "tweakreg": {"skip": not align},
        "skymatch": {"skip": not level},
        # the default weighs pixels by their read noise, less where a cosmic ray has cut the ramp:
        # stars with hits in the core are then up to 2 % off, however exact the exposures are
        "resample": {"weight_type": "exptime"},
    }
    Image3Pipeline.call(str(path), save_results=True, output_dir=output, steps=steps)


if __name__ == "__main__":
    stage, folder, *paths = sys.argv[1:]
    stage, _, kept = stage.partition("+")
    more = {
        "ramp": {"save_calibrated_ramp": True},
        "align": {"align": True},
        "level": {"level": False},
    }
    options = more.get(kept, {})
    socket.socket.connect = socket.socket.connect_ex = refuse
    {"detector1": detector1, "image2": image2, "image3": image3}[stage](paths, folder, **options)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    Path(folder, f"{stage}.json").write_text(json.dumps({"attempts": attempts, "peak_mb": peak}))
