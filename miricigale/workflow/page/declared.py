"""What is declared of the study's page in `sections.toml`."""

from miricigale.utils.declared import declared


def texts_of(section):
    """Return the sentences and tables of a section by name, as they stand in the file."""
    return declared("miricigale.workflow.page", "sections.toml")[section]
