"""Every public name is documented; `make docs` also checks that it is on a page."""

import pathlib

from public_names import public_names

PACKAGE = pathlib.Path(__file__).parents[1] / "src" / "cablejax"


def test_every_public_name_is_documented():
    names = public_names(PACKAGE)
    assert len(names) > 1000
    assert not [name.path for name in names if not name.documented]


def test_what_counts_as_documented(tmp_path):
    package = tmp_path / "toy"
    package.mkdir()
    (package / "__init__.py").write_text('"""A package."""\n')
    (package / "_hidden.py").write_text("NAME = 1\n")
    (package / "base.py").write_text(
        '"""Base."""\n\nclass Base:\n    """A base.\n\n    Attributes:\n        shared, other: from here on.\n    """\n'
    )
    (package / "derived.py").write_text(
        "from toy.base import Base\n"
        "FIRST, SECOND = 1, 2\n"
        '"""Two numbers."""\n'
        "BARE = 3\n"
        "class Derived(Base):\n"
        "    shared: int\n"
        "    own: int\n"
        "    _private: int\n"
        "    def method(self): ...\n"
    )
    documented = {name.path: name.documented for name in public_names(package)}
    assert documented == {
        "toy": True,
        "toy.base": True,
        "toy.base.Base": True,
        "toy.derived": False,
        "toy.derived.FIRST": True,
        "toy.derived.SECOND": True,
        "toy.derived.BARE": False,
        "toy.derived.Derived": False,
        "toy.derived.Derived.shared": True,
        "toy.derived.Derived.own": False,
        "toy.derived.Derived.method": False,
    }
