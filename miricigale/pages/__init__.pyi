from .page import Page as Page
from .rendering import render as render
from .sections import SectionWriter as SectionWriter
from .sections import sentence as sentence
from .values import Link as Link
from .values import Missing as Missing
from .values import cell_of as cell_of
from .values import number as number
