"""The folder of reduced exposures: what stands in it, and what may be replaced."""

from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.folder import PARTIAL, RecordFolder, check_folder


class ProductFolder(RecordFolder):
    """
    Folder of reduced exposures, which may hold files of others too; see `~miricigale.utils.folder.RecordFolder`.

    Every product is a record by its name. A file without a record, or with another content than its record
    says, is not ours and is replaced only if the caller asks for it. In a ``with`` statement the folder is locked.

    Parameters
    ----------
    folder : path-like
        Made when something is written, if it does not exist.
    overwrite : bool, optional
        Whether files of others and edited ones are replaced.
    """

    purpose = "reduction"
    lock_name = "reduce.lock"
    # a download folder or the folder of a run may have a manifest.json
    manifest_name = "reduce"

    def __init__(self, folder, *, overwrite=False):
        self.overwrite = overwrite
        super().__init__(folder)

    def _refuse_foreign(self, *, damaged):
        """Refuse a file in place of the folder; files of others stay, and none is taken for ours."""
        check_folder(self.folder)

    def _unfinished(self):
        """Unfinished products of a reduction that was killed; other programs may write in the folder too."""
        paths = self.folder.glob(f"{PARTIAL}*")
        # .partial-<process>-<random>-<name>
        return [path for path in paths if path.name.split("-", 3)[-1] in self.records]

    def check_replaceable(self, names):
        """
        Refuse to replace files that this folder's reductions did not write, or that were edited since.

        Parameters
        ----------
        names : iterable of str
            Names of products that are to be written.

        Raises
        ------
        ValueError
            With all of these files, unless they may be replaced.
        """
        if self.overwrite:
            return
        reasons = []
        for name in dict.fromkeys(names):
            try:
                standing = self.path(name).exists()
            except DataError:
                # a symbolic link: what it points to is not ours
                standing = True
            if not standing:
                continue
            if name not in self.records:
                reasons.append(f"{name} (not written by a reduction here)")
            elif not self.is_whole(name):
                reasons.append(f"{name} (changed since it was written)")
        if reasons:
            wanted = "a folder where no file of others is replaced (or 'overwrite' given)"
            raise argument_error("folder", wanted, f"{self.folder} with {', '.join(reasons)}")

    def is_kept(self, name, key, *, resume=True):
        """Tell whether a product of this key stands, with the content that was written."""
        return resume and self.is_current(name, key)

    def write(self, name, key, writer):
        """
        Write a product, and record it.

        Parameters
        ----------
        name : str
            Its name.
        key : str
            Checksum of everything that it depends on.
        writer : callable
            Called with its path; it replaces the file wholly or not at all.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        ValueError
            As `check_replaceable`.
        """
        self.check_replaceable([name])
        path = self.path(name)
        writer(path)
        self.finish(name, key, {name: self.describe(name)})
        return path
