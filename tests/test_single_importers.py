from single_importers import single_importers, table_rows


def test_the_page_lists_every_module_with_a_single_importer_and_gives_a_reason():
    listed = {f"imitarm.{module}": f"imitarm.{importer}" for module, (importer, _) in table_rows().items()}
    assert listed == single_importers()
    assert all(reason for _, reason in table_rows().values())


def test_fewer_than_25_of_them_are_neither_members_of_a_registry_nor_exported_by_their_folder():
    inherent = ("member of a registry", "exported by its folder")
    others = [module for module, (_, reason) in table_rows().items() if not reason.startswith(inherent)]
    assert len(others) < 25


def test_names_in_imports_and_in_registries_count(tmp_path):
    package = tmp_path / "imitarm" / "family"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('MEMBERS = {"a": "imitarm.family.a:A"}\nfrom imitarm.family import b, c\n')
    (package / "a.py").write_text("import imitarm.family.c\n")
    (package / "b.py").write_text("")
    (package / "c.py").write_text("from imitarm.family.c import itself\n")
    owner = "imitarm.family"
    assert single_importers(tmp_path) == {"imitarm.family.a": owner, "imitarm.family.b": owner}
