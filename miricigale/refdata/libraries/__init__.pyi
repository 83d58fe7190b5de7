from .register import READERS as READERS
from .register import Report as Report
from .register import add_library as add_library
from .table import LibraryTable as LibraryTable
from .table import open_library as open_library
from .table import verify_library as verify_library
from .table import write_library as write_library
