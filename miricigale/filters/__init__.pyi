from .band_names import cigale_band as cigale_band
from .band_names import filter_of_band as filter_of_band
from .catalog_files import read_catalog_photometry as read_catalog_photometry
from .catalog_map import CatalogMap as CatalogMap
from .filter import Filter as Filter
from .filter_set import FilterSet as FilterSet
from .filter_set import filter_table as filter_table
from .surveys import SURVEYS as SURVEYS
