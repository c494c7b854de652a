from imitarm.cli import COMMANDS
from single_importers import HEADING, ROOT, fragments, modules, single_importers, summary, table_rows


def test_the_page_lists_every_module_with_a_single_importer_and_gives_a_reason():
    listed = {f"imitarm.{module}": f"imitarm.{importer}" for module, (importer, _) in table_rows().items()}
    assert listed == single_importers()
    assert all(reason for _, reason in table_rows().values())


def test_fewer_than_26_of_them_are_neither_members_of_a_registry_nor_exported_by_their_folder():
    assert len(fragments()) < 25


def test_modules_said_to_be_members_or_exported_are_so():
    files = modules(ROOT / "src")
    for module, (importer, reason) in table_rows().items():
        owner = files[f"imitarm.{importer}"].read_text(encoding="utf-8")
        if reason.startswith("exported by its folder"):
            assert module.rpartition(".")[0] == importer
            assert f"from imitarm.{module} import" in owner
        if reason.startswith("member of a registry"):
            command = module.removeprefix("cli.")
            assert f'"imitarm.{module}:' in owner or f"from imitarm.{module} import" in owner or command in COMMANDS


def test_the_two_counts_add_up(tmp_path):
    page = tmp_path / "page.md"
    rows = (
        "| `a.b` | `a` | exported by its folder |\n| `a.c` | `a` | member of a registry |\n| `a.d` | `a.b` | long |\n"
    )
    page.write_text(f"{HEADING}\n\n| module | importer | why |\n|---|---|---|\n{rows}\n## Next\n")
    assert fragments(page) == ["a.d"]
    assert summary(page) == "3 modules: 2 are members of a registry or exported by their folder, 1 are not"


def test_names_in_imports_and_in_registries_count(tmp_path):
    package = tmp_path / "imitarm" / "family"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('MEMBERS = {"a": "imitarm.family.a:A"}\nfrom imitarm.family import b, c\n')
    (package / "a.py").write_text("import imitarm.family.c\n")
    (package / "b.py").write_text("")
    (package / "c.py").write_text("from imitarm.family.c import itself\n")
    owner = "imitarm.family"
    assert single_importers(tmp_path) == {"imitarm.family.a": owner, "imitarm.family.b": owner}
