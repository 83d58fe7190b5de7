"""What columns of tables of results hold."""

from miricigale.utils.package_tables import declared

#: Error of a redshift over 1 + z beyond which it is called an outlier.
OUTLIER = 0.15
#: What the column of the odds of redshifts is.
ODDS = f"probability that redshift_p50 is within {OUTLIER} (1 + z) of the redshift"
TEXTS = declared("miricigale.fitting", "columns.toml")
#: Fields of results whose columns have another name.
FIELDS = {"id": "ids", "chi2_best": "chi2"}
