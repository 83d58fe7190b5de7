"""Progress in sessions, and none in scripts and pipes."""

import os
import struct
import subprocess
import sys

import pytest

#: A measurement of a source on an image of 0.25 megapixels; sessions have a prompt, scripts none.
MEASUREMENT = """
import sys
{prompt}
import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from miricigale import ForcedPhotometer
from miricigale.instrument import north_up_wcs
from miricigale.psf import gaussian_psf

psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=3 * u.arcsec)
noise = np.random.default_rng(1).normal(size=(500, 500))
wcs = north_up_wcs("10:00:00 +02:00:00", 0.1 * u.arcsec, noise.shape)
error = StdDevUncertainty(np.ones(noise.shape))
image = CCDData(noise, unit="MJy/sr", wcs=wcs, uncertainty=error)
ForcedPhotometer(psf=psf).measure(image, wcs.pixel_to_world([250], [250]))
"""


def at_terminal(code):
    """Return what Python writes on a terminal of 100 columns."""
    fcntl = pytest.importorskip("fcntl")
    import pty
    import termios

    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    command = [sys.executable, "-W", "ignore", "-c", code]
    with subprocess.Popen(command, stdout=terminal, stderr=terminal):
        os.close(terminal)
        parts = []
        while True:
            try:
                part = os.read(reader, 4096)
            except OSError:
                # the other end is closed
                break
            if not part:
                break
            parts.append(part)
    os.close(reader)
    return b"".join(parts).decode()


def test_a_long_measurement_shows_its_steps_in_sessions_alone():
    session = MEASUREMENT.format(prompt="sys.ps1 = '>>> '")
    shown = at_terminal(session)
    for step in ("photometry, templates", "photometry, fit", "photometry, errors", "3/4"):
        assert step in shown
    # a script at a terminal, and a session whose output goes to a file
    assert at_terminal(MEASUREMENT.format(prompt="")) == ""
    command = [sys.executable, "-W", "ignore", "-c", session]
    piped = subprocess.run(command, capture_output=True, check=True)
    assert piped.stdout == piped.stderr == b""
