"""Star-formation histories, in steps of 1 Myr."""

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter

__all__ = ["DelayedSFH", "StarFormationHistory"]


class StarFormationHistory(Component):
    """Base: `history` gives rates that form one solar mass."""

    role = "sfh"
    age = Parameter(
        default=1.0,
        bounds=(0.001, 13.7),
        unit="Gyr",
        doc="Time since the first stars formed; rounded to 1 Myr.",
    )

    def steps(self, values):
        """Number of steps of 1 Myr."""
        return max(1, round(values["age"] * 1e3))

    def history(self, values):
        """
        Star-formation rate.

        Returns
        -------
        rate : `~numpy.ndarray`, shape (n_steps,)
            In Msun/yr for one solar mass formed, oldest step first.
        """
        raise NotImplementedError


@register
class DelayedSFH(StarFormationHistory):
    """
    Delayed exponential history, with an optional recent burst.

    ``SFR_t = t exp(-t / tau) / tau^2`` for t = 0, 1, ... age - 1 Myr, and an exponential burst
    in the last ``age_burst`` that makes the fraction ``f_burst`` of all stars.
    """

    name = "delayed"
    reference = "Boquien et al. 2019, A&A 622, A103, eq. 3"
    tau = Parameter(default=1.0, bounds=(0.001, 100.0), unit="Gyr", doc="E-folding time.")
    f_burst = Parameter(default=0.0, bounds=(0.0, 0.99), doc="Mass fraction made in the burst.")
    age_burst = Parameter(
        default=0.02, bounds=(0.001, 5.0), unit="Gyr", doc="Time since the burst began."
    )
    tau_burst = Parameter(
        default=0.05, bounds=(0.001, 100.0), unit="Gyr", doc="E-folding time of the burst."
    )

    def history(self, values):
        return _core.delayed_history(
            self.steps(values),
            values["tau"] * 1e3,
            values["f_burst"],
            max(1, round(values["age_burst"] * 1e3)),
            values["tau_burst"] * 1e3,
        )

    def inert(self, values):
        return ("age_burst", "tau_burst") if values["f_burst"] == 0.0 else ()

    def invalid(self, values):
        if values["f_burst"] > 0.0 and values["age_burst"] > values["age"]:
            return "'age_burst' must not exceed 'age'"
        return None
