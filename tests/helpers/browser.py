"""What pages of single sources hold, and how they look in a browser without a screen."""

import json
import os
import re
import shutil
import subprocess

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


def read_sources(page, folder):
    """Facts of a page of sources, and the details of all sources in its order."""
    text = page.read_text("utf-8")
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', text, flags=re.DOTALL)[1])
    entries = []
    for k, path in enumerate(sorted(folder.glob("*.js"))):
        call = re.fullmatch(rf"loaded\({k}, (.*)\);\n", path.read_text("utf-8"))
        entries += json.loads(call[1])
    return facts, entries


def opened(page, address, folder):
    """The document after its script has run."""
    command = [
        BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}",
        "--virtual-time-budget=4000", "--dump-dom", f"{page.as_uri()}#{address}",
    ]  # fmt: skip
    options = {"capture_output": True, "text": True, "timeout": 120, "check": True}
    return subprocess.run(command, env=dict(os.environ), **options).stdout
