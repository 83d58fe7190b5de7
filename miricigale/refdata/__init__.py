"""Reference data: one record per resource, one function that finds it."""

from miricigale.refdata.check import ResourceState, check_resources
from miricigale.refdata.locate import cache_folder, conf, find_resource, locate
from miricigale.refdata.registry import Registry, Resource, citations, resource, resources
from miricigale.refdata.store import add_resource

__all__ = [
    "Registry",
    "Resource",
    "ResourceState",
    "add_resource",
    "cache_folder",
    "check_resources",
    "citations",
    "conf",
    "find_resource",
    "locate",
    "resource",
    "resources",
]


def __dir__():
    return sorted(__all__)
