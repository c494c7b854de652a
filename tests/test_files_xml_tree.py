from __future__ import annotations

import pytest

from imitarm.errors import FileFormatError
from imitarm.files.xml_tree import read_xml

TEXT = """<?xml version="1.0"?>
<robot name="r">
  <link name="a"/>

  <joint name="j"
         type="revolute">
    <limit lower="-1"/>
  </joint>
  <xacro:macro name="m"/>
</robot>
"""


def test_elements_know_their_line_and_are_walked_in_order(tmp_path):
    path = tmp_path / "a.urdf"
    path.write_text(TEXT)
    root = read_xml(path)
    assert [(element.tag, element.line) for element in root.walk()] == [
        ("robot", 2), ("link", 3), ("joint", 5), ("limit", 7), ("xacro:macro", 9),
    ]  # fmt: skip
    joint = root.find("joint")
    assert joint is not None and joint.get("type") == "revolute" and joint.get("absent", "x") == "x"
    assert root.find("limit") is None and len(root.all("link")) == 1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"a,b\n1,2\n",
        TEXT[:60].encode(),
        bytes(range(256)),
        b"<a/><b/>",
        b'<?xml version="1.0" encoding="no-such"?><a/>',
    ],
)
def test_what_is_no_xml_is_refused_with_the_file_and_what_was_expected(tmp_path, data):
    path = tmp_path / "a.urdf"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"not an XML file.*a URDF file was expected") as caught:
        read_xml(path, "a URDF file")
    assert str(path) in str(caught.value)
