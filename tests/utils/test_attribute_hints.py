"""Names that other packages use: each is an attribute here, or ends in a sentence with the right one."""

import operator
import re

import pytest

import miricigale
from miricigale import Filter, SEDModel, fitting, photometry, reduction
from miricigale.utils.attribute_hints import attribute_hint
from miricigale.utils.interactive import Interactive
from miricigale.utils.package_tables import declared, hint_sentences

HINTS = {k: v for k, v in declared("miricigale.utils", "hints.toml").items() if k != "words"}
OTHER_NAMES = declared("miricigale.utils", "other_names.toml")


def class_of(name):
    """Return a class of the package, or of a subpackage, by name; None if there is none."""
    for module in (miricigale, photometry, fitting, reduction):
        if name in module.__all__:
            return getattr(module, name)
    return None


#: Classes that sentences may name.
PUBLIC = set(miricigale.__all__)


@pytest.mark.parametrize("name", HINTS)
def test_sentences_name_what_there_is(name):
    cls = class_of(name)
    assert issubclass(cls, Interactive)
    for wrong, sentence in hint_sentences(HINTS[name]).items():
        assert wrong not in dir(cls), f"{name}.{wrong} is an attribute"
        assert wrong not in OTHER_NAMES.get(name, {}), f"{name}.{wrong} is an alias"
        words = set(re.findall(r"\w+", sentence))
        fields = set(getattr(cls, "__dataclass_fields__", ()))
        assert words & (set(dir(cls)) | fields | PUBLIC | {"len"}) or "miricigale." in sentence, (
            sentence
        )
        for path in re.findall(r"miricigale((?:\.\w+)+)", sentence):
            operator.attrgetter(path[1:])(miricigale)


@pytest.mark.parametrize("name", list(filter(class_of, OTHER_NAMES)))
def test_other_names_are_of_attributes(name):
    cls = class_of(name)
    fields = getattr(cls, "__dataclass_fields__", {})
    for other, ours in OTHER_NAMES[name].items():
        assert other not in set(dir(cls)) | set(fields), other
        first = ours.removesuffix("()").partition(".")[0]
        # of fitters and results some are set, or found among the quantities, of an instance
        own = {
            "BayesFitter": {"filters"},
            "FitResults": {"redshift", "stellar_mass"},
            "Ramp": {"exposure"},
        }
        own["FitResults"] |= {"redshift_p16", "redshift_p50", "redshift_p84"}
        own["SED"] = {"frac_agn", "beta"}
        own["SEDModel"] = {"components", "cosmology"}
        own["Ramp"] |= {"pixel_dq", "group_dq"}
        assert first in set(dir(cls)) | set(fields) | own.get(name, set()), (other, ours)


def test_nearest_names_by_spelling_and_by_meaning():
    names = ["synthetic_flux", "synthetic_magnitude", "pivot", "plot", "_private"]
    assert attribute_hint(Filter, "pivt", names) == "did you mean 'pivot'?"
    assert attribute_hint(Filter, "draw_curve", names) == "did you mean 'plot'?"
    assert "synthetic_magnitude" in attribute_hint(Filter, "get_mags", names)
    assert attribute_hint(Filter, "vega_zeropoint", names).startswith(
        "synthetic_magnitude(sed) is AB"
    )
    # classes say in general what they have, others list it
    assert attribute_hint(Filter, "xyzzy", names).startswith("name ('miri.f770w') has instr")
    assert attribute_hint(object, "xyzzy", ["pivot", "plot", "_private"]) == "it has pivot, plot"
    assert attribute_hint(object, "xyzzy", [f"name_{i}" for i in range(50)]) == ""
    # words such as "to" say nothing
    assert attribute_hint(object, "to_vega", ["to_table"] * 50) == ""
    model = SEDModel.yang2021(libraries="bundled", agn=False)
    with pytest.raises(AttributeError, match=r"no attribute 'get_photometry'; fluxes\(filters, "):
        model.get_photometry  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'xyzzy'; parameters are all that "):
        model.xyzzy  # noqa: B018
    assert not hasattr(model, "free_parameters")
