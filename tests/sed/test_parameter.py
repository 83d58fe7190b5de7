import astropy.units as u
import pytest

from helpers.errors import refuses
from miricigale.sed import COMPONENTS, Component, Parameter


class Example(Component):
    name = "example"
    role = "agn"
    length = Parameter(default=2.0, bounds=(1.0, 10.0), unit="m", doc="A length.")


def test_parameter_is_itself_on_the_class_and_a_number_on_an_instance():
    assert isinstance(Example.length, Parameter)
    assert Example().length == 2.0
    assert Example(length=300 * u.cm).length == 3.0
    assert Example(length=3.0).parameters["length"].default == 3.0
    assert Example().parameters["length"].default == 2.0


def test_parameter_converts_units_and_refuses_others():
    par = Example.length
    assert par.check(0.005 * u.km) == pytest.approx(5.0)
    refuses("'length' must be convertible to m", par.check, 3 * u.s, error=u.UnitsError)


@pytest.mark.parametrize("value", [0.5, 11.0, float("nan"), float("inf")])
def test_parameter_refuses_values_outside_its_bounds(value):
    refuses("'length' must be from 1", Example.length.check, value)


def test_component_is_frozen_and_knows_its_parameters():
    with pytest.raises(AttributeError, match="when the component is made"):
        Example().length = 4.0
    refuses("no parameter 'width'; known: length", Example, error=TypeError, width=1.0)


@pytest.mark.parametrize("name", COMPONENTS.names())
def test_every_component_declares_unit_bounds_doc_and_reference(name):
    cls = COMPONENTS.get(name)
    assert cls.reference
    for parameter in cls.declared().values():
        assert isinstance(parameter.unit, u.UnitBase)
        low, high = parameter.bounds
        assert low <= parameter.default <= high > low
        assert parameter.doc.endswith(".")
