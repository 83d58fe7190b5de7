"""
Kernels of the grid fit: arrays in, arrays out.

`sum_up` (`evaluate`) does one object. Models without AGN are evaluated one by one. The pairs of galaxy and AGN
model that can matter are listed by their bounds (`pairs`, down to those of `floors`), evaluated side by side
(`batched_pairs`, `single` in single precision, `limits` with upper limits) and summed up (`sums`, `histogram`);
`summarize` turns the sums into moments and quantiles. `weigh_masses` (`masses`) puts a prior of mass in,
`find_models` (`mixture`) finds wrong bands. `interpolate_light` (`interpolation`) and `evaluate_places`
(`population`, `nuclei`, `importance`) are of models between nodes, `part_fits` fits what proposes them, and
`allocation` says where more are wanted; `lanes` adds their light up, `summaries` what results are of.
`structs` says what the kernels take and where it stands there, `workspace` makes it.
"""

from miricigale.fitting._core.allocation import (
    allocate_places,
    make_group_sets,
    mix_peaks,
    weigh_places,
)
from miricigale.fitting._core.evaluate import sum_up
from miricigale.fitting._core.histogram import (
    N_SHARE,
    PER_DEX,
    make_scales,
    percentile_places,
    summarize,
)
from miricigale.fitting._core.importance import (
    FREEDOM,
    Labels,
    Parts,
    add_density,
    evaluate_places,
    propose,
)
from miricigale.fitting._core.interpolation import (
    SATURATION,
    Light,
    Part,
    interpolate_columns,
    interpolate_exponentials,
    interpolate_light,
    make_work,
)
from miricigale.fitting._core.masses import weigh_masses
from miricigale.fitting._core.mixture import find_models
from miricigale.fitting._core.nuclei import Nuclei
from miricigale.fitting._core.part_fits import (
    add_local_parts,
    add_widest,
    fit_groups,
    fit_parts,
    flatten,
    mean_and_cov,
)
from miricigale.fitting._core.population import NEVER, Masses, Mixture, Object, Space
from miricigale.fitting._core.scan import (
    TOGETHER,
    ScannedGalaxies,
    ScannedObjects,
    draw_agn,
    draw_nodes,
    make_scan_work,
    scan_nodes,
)
from miricigale.fitting._core.structs import BLOCK, Request, Tables
from miricigale.fitting._core.summaries import sort_draws
from miricigale.fitting._core.workspace import (
    JOINT,
    aligned,
    clear,
    make_few,
    make_limits,
    make_sums,
    make_target,
    make_workspace,
    weighed,
)
