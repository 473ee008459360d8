"""Vector files of a sheet: SVG and PDF, in millimetres, without a library: boxes, discs and a few words need none."""

from xml.sax.saxutils import escape

from binpick_calib.sheet import Box, Disc, Sheet

_POINT_PER_MM = 72 / 25.4
_CURVE = 0.5522847498
"""Share of the radius at which a cubic's handles lie when four make a circle (off it by 0.03 % of the radius at most)."""


def svg(sheet: Sheet) -> bytes:
    """The sheet as one path, so that neighbouring shapes leave no hairline between them, and lines of text."""
    paths = "".join(_svg_shape(shape) for shape in sheet.shapes)
    lines = "".join(f'<text x="{line.x:g}" y="{line.y:g}" font-size="{line.size:g}" font-family="Helvetica, Arial, sans-serif">'
                    f"{escape(line.text)}</text>\n" for line in sheet.lines)
    w, h = f"{sheet.width:g}", f"{sheet.height:g}"
    return (f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="0 0 {w} {h}">\n'
            f'<rect width="{w}" height="{h}" fill="white"/>\n<path d="{paths}"/>\n{lines}</svg>\n').encode()


def _svg_shape(shape: Box | Disc) -> str:
    if isinstance(shape, Box):
        return f"M{shape.x:.4f} {shape.y:.4f}h{shape.width:.4f}v{shape.height:.4f}h{-shape.width:.4f}z\n"
    r = shape.radius
    return f"M{shape.x - r:.4f} {shape.y:.4f}a{r:.4f} {r:.4f} 0 1 0 {2 * r:.4f} 0a{r:.4f} {r:.4f} 0 1 0 {-2 * r:.4f} 0z\n"


def pdf(sheet: Sheet) -> bytes:
    """The sheet as a PDF of one page; no date in it, so that the same board gives the same file."""
    flip = f"{_POINT_PER_MM:.8f} 0 0 {-_POINT_PER_MM:.8f} 0 {sheet.height * _POINT_PER_MM:.6f} cm\n"    # mm, y down
    shapes = "".join(_pdf_shape(shape) for shape in sheet.shapes)
    lines = "".join(f"BT /F1 {line.size:g} Tf 1 0 0 -1 {line.x:g} {line.y:g} Tm ({_pdf_text(line.text)}) Tj ET\n"
                    for line in sheet.lines)
    drawing = f"{flip}0 g\n{shapes}f\n{lines}".encode("cp1252")
    page = f"[0 0 {sheet.width * _POINT_PER_MM:.4f} {sheet.height * _POINT_PER_MM:.4f}]"
    fonts = "/Resources << /Font << /F1 5 0 R >> >>"
    objects = [b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
               b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
               f"<< /Type /Page /Parent 2 0 R /MediaBox {page} /Contents 4 0 R {fonts} >>".encode(),
               b"<< /Length %d >>\nstream\n%s\nendstream" % (len(drawing), drawing),
               b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>"]
    return _pdf_file(objects)


def _pdf_file(objects: list[bytes]) -> bytes:
    """Numbered objects, and the table of where in the file each begins."""
    written, begins = b"%PDF-1.6\n", []
    for number, content in enumerate(objects, start=1):
        begins.append(len(written))
        written += b"%d 0 obj\n%s\nendobj\n" % (number, content)
    table = b"".join(b"%010d 00000 n \n" % begin for begin in begins)
    return written + (b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
                      % (len(objects) + 1, table, len(objects) + 1, len(written)))


def _pdf_shape(shape: Box | Disc) -> str:
    if isinstance(shape, Box):
        return f"{shape.x:.4f} {shape.y:.4f} {shape.width:.4f} {shape.height:.4f} re\n"
    x, y, r, k = shape.x, shape.y, shape.radius, _CURVE * shape.radius
    quarters = ((r, k, k, r, 0, r), (-k, r, -r, k, -r, 0), (-r, -k, -k, -r, 0, -r), (k, -r, r, -k, r, 0))
    curves = "".join(f"{x + a:.4f} {y + b:.4f} {x + c:.4f} {y + d:.4f} {x + e:.4f} {y + f:.4f} c\n"
                     for a, b, c, d, e, f in quarters)
    return f"{x + r:.4f} {y:.4f} m\n{curves}h\n"


def _pdf_text(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
