"""Reference data: one record per resource, one function that finds it."""

from miricigale.refdata.locate import add_resource, check_resources, conf, locate
from miricigale.refdata.registry import Registry, Resource, citations, resource, resources

__all__ = [
    "Registry",
    "Resource",
    "add_resource",
    "check_resources",
    "citations",
    "conf",
    "locate",
    "resource",
    "resources",
]
