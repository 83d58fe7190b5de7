"""
Time an object takes with continuous parameters: ``python benchmarks/samplers.py [engine ...]``.

Eight free parameters (redshift, tau, age, E(B-V), alpha, AGN fraction, polar E(B-V), tau9.7), ten
bands at 5 % noise, two objects. Processor seconds, for other work on the machine does not count.
"""

import sys
import time

import numpy as np
from astropy.table import QTable

from miricigale.fitting import BayesFitter
from miricigale.sed import SEDModel

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2"]
BANDS += ["miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"]
TRUTH = {
    "redshift": [1.0, 2.0],
    "tau": [1.0, 2.0],
    "age": [2.0, 1.0],
    "ebv": [0.3, 0.2],
    "frac_agn": [0.3, 0.1],
    "mass": [1e10, 3e10],
}
PRIORS = {
    "redshift": (0.01, 6.0),
    "tau": (0.1, 10.0, "log"),
    "age": (0.1, 10.0),
    "ebv": (0.0, 1.0),
    "alpha": (1.0, 2.5),
    "frac_agn": (0.0, 0.99),
    "ebv_polar": (0.0, 0.3),
    "tau97": [3.0, 5.0, 7.0, 9.0, 11.0],
}


def main(engines):
    model = SEDModel.yang2021(libraries="bundled")
    fluxes = model.fluxes(QTable(TRUTH), BANDS)
    rng = np.random.default_rng(0)
    photometry = QTable({"id": ["a", "b"]})
    for name in BANDS:
        photometry[name] = fluxes[name] * (1.0 + 0.05 * rng.normal(size=2))
        photometry[f"{name}_err"] = 0.05 * fluxes[name]
    print("engine     id  s     models  effective  converged  redshift        ln evidence")
    for engine in engines:
        fitter = BayesFitter(model, BANDS, priors=PRIORS, engine=engine)
        for row in range(2):
            start = time.process_time()
            results = fitter.fit(photometry[row : row + 1], seed=1)
            took = time.process_time() - start
            z, dz = results.mean("redshift")[0], results.std("redshift")[0]
            print(
                f"{engine:10s} {results.ids[0]:2s} {took:6.1f} {results.n_calls[0]:6d} "
                f"{results.n_effective[0]:8.0f} {results.converged[0]!s:>10s} "
                f"  {z:.3f} +- {dz:.3f}  {results.log_evidence[0]:.2f} +- "
                f"{results.log_evidence_err[0]:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:] or ["nautilus", "dynesty"])
