"""A page that opens offline, by day and by night, on a desk and on a phone: its shell, its colours, its script."""

import base64
from html import escape

SERIES = 6
"""Colours that the page's style has for what is drawn, as classes c1 to c6: after Okabe and Ito, by day and night."""

STYLE = """
:root{color-scheme:light dark;--paper:#fff;--card:#f6f8fa;--ink:#1b1f24;--soft:#57606a;--line:#d5dbe1;--link:#0b5cad;
 --bad:#a3341b;--c1:#0072b2;--c2:#ad4a00;--c3:#00805e;--c4:#a8498a;--c5:#8a6d00;--c6:#5a6570}
@media (prefers-color-scheme:dark){:root{--paper:#0f1419;--card:#182029;--ink:#e6edf3;--soft:#a3afbb;--line:#313c48;
 --link:#7cbcff;--bad:#ff9a80;--c1:#56b4e9;--c2:#f39c4a;--c3:#3fcfa4;--c4:#e39ac6;--c5:#e8d44d;--c6:#9aa7b4}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans",sans-serif;color:var(--ink);
 background:var(--paper);max-width:1200px;margin:0 auto;padding:24px 24px 64px;overflow-wrap:anywhere}
h1{font-size:26px;line-height:1.2;margin:0 0 4px}h1 span{font-weight:400;color:var(--soft)}
h2{font-size:21px;margin:44px 0 4px;padding-top:14px;border-top:1px solid var(--line)}
h3{font-size:16px;margin:26px 0 8px}
p{margin:4px 0 12px}a{color:var(--link)}.soft,.note{color:var(--soft)}.bad{color:var(--bad)}
:focus-visible{outline:3px solid var(--link);outline-offset:2px}
nav{display:flex;flex-wrap:wrap;gap:4px 16px;margin:10px 0 0}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(250px,1fr));gap:14px;margin:18px 0 0;padding:0}
.card{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px 16px}
.card h3{margin:0;font-size:14px;color:var(--soft);font-weight:600}
.card .big{font-size:32px;line-height:1.15;margin:4px 0 6px;font-weight:600;font-variant-numeric:tabular-nums}
.card .big span{font-size:15px;line-height:1.3;display:block;font-weight:400;color:var(--soft)}
.card p{margin:2px 0;font-size:14px}
.wide{overflow-x:auto;margin:0 0 6px;border:1px solid var(--line);border-radius:8px}
.tall{max-height:min(75vh,900px);overflow-y:auto;content-visibility:auto;contain-intrinsic-size:auto 640px}
.tall thead th{position:sticky;top:0;z-index:1}.tall thead tr>:first-child{z-index:2}
.tall tfoot{position:sticky;bottom:0;z-index:1}
table{border-collapse:separate;border-spacing:0;width:100%;font-variant-numeric:tabular-nums;font-size:14px;overflow-wrap:normal}
th,td{text-align:right;padding:5px 12px;border-bottom:1px solid var(--line);white-space:nowrap;vertical-align:top}
tbody tr:last-child>*{border-bottom:0}tfoot tr:first-child>*{border-top:2px solid var(--line)}
tfoot tr:last-child>*{border-bottom:0}tfoot th,tfoot td{background:var(--card)}
th{font-weight:600}tbody th{font-weight:400}
th.text,td.text{text-align:left}td.text{white-space:normal;min-width:12em;overflow-wrap:anywhere}
thead th{background:var(--card);color:var(--soft);vertical-align:bottom;padding:0}
thead th>span{display:block;padding:5px 12px}
tr>:first-child{position:sticky;left:0;background:var(--paper)}thead tr>:first-child,tfoot tr>:first-child{
 background:var(--card)}
td small{display:block;color:var(--soft);font-size:12px}
thead button{all:unset;box-sizing:border-box;display:block;width:100%;padding:5px 12px;cursor:pointer;
 text-align:inherit}
thead button::after{content:"\\2195";opacity:.45;padding-left:4px}
thead [aria-sort=ascending] button::after{content:"\\2191";opacity:1}
thead [aria-sort=descending] button::after{content:"\\2193";opacity:1}
thead button:focus-visible{outline:3px solid var(--link);outline-offset:-3px}
input[type=search]{font:inherit;color:inherit;background:var(--paper);border:1px solid var(--line);border-radius:6px;
 padding:4px 10px;margin:0 0 8px;width:260px;max-width:100%}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,340px),1fr));gap:14px;align-items:start;
 margin:0 0 18px}
.plots figure{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:10px}
figure{margin:0}figcaption{font-size:13px;color:var(--soft);margin-top:4px}figcaption b{color:var(--ink)}
img,svg{width:100%;height:auto;display:block}
svg text{font-size:12px;fill:var(--soft)}svg text.name{fill:var(--ink)}svg text.title{font-size:13px;font-weight:600;
 fill:var(--ink)}
svg .grid{stroke:var(--line);fill:none}svg .axis{stroke:var(--soft);fill:none}
svg .line{fill:none;stroke-width:2;stroke-linejoin:round}svg .faint{fill:none;stroke-width:1.2;opacity:.45}
svg .band{stroke:none;opacity:.2}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,540px),1fr));gap:18px}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(220px,1fr));gap:4px}
 .pair img{border-radius:4px;background:#777}
.pair span{font-size:12px;color:var(--soft)}
.key{display:flex;flex-wrap:wrap;gap:4px 18px;padding:0;margin:0 0 12px;list-style:none;font-size:14px}
.key svg{display:inline-block;width:26px;height:16px;vertical-align:-3px;margin-right:6px}
details{margin:10px 0}summary{cursor:pointer;font-weight:600}
pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px;overflow:auto;font-size:13px}
ul{padding-left:20px;margin:4px 0 12px}
@media (max-width:600px){body{padding:16px 14px 48px}h1{font-size:22px}th,td{padding:5px 8px}
 thead button,thead th>span{padding:5px 8px}
 .wide tr>:first-child{min-width:8.5em;max-width:42vw;white-space:normal;overflow-wrap:anywhere}
 .card .big{font-size:28px}}
@media print{body{max-width:none}.wide{overflow:visible;max-height:none;content-visibility:visible}}
""" + "".join(
    f"svg .c{k}{{stroke:var(--c{k})}}svg .f{k}{{fill:var(--c{k});stroke:none}}svg text.f{k}{{fill:var(--c{k})}}"
    for k in range(1, SERIES + 1)
)

SCRIPT = """
document.querySelectorAll("table.sorts").forEach(function(table){
 var body=table.tBodies[0],heads=Array.from(table.tHead.rows[0].cells);
 function worth(row,k){var said=row.cells[k].getAttribute("data-v");
  if(said===null||said==="")return null;var number=Number(said);return isNaN(number)?said:number;}
 function compare(a,b){if(typeof a==="number"&&typeof b==="number")return a-b;
  return String(a).localeCompare(String(b),undefined,{numeric:true});}
 heads.forEach(function(head,k){var button=head.querySelector("button");if(!button)return;
  button.addEventListener("click",function(){
   var down=head.getAttribute("aria-sort")==="ascending";
   heads.forEach(function(other){other.removeAttribute("aria-sort");});
   head.setAttribute("aria-sort",down?"descending":"ascending");
   Array.from(body.rows).map(function(row){return[worth(row,k),row];}).sort(function(a,b){
    if(a[0]===null||b[0]===null)return(a[0]===null)-(b[0]===null);
    return down?compare(b[0],a[0]):compare(a[0],b[0]);
   }).forEach(function(pair){body.appendChild(pair[1]);});
  });});
 if(body.rows.length>12){var field=document.createElement("input");field.type="search";
  field.placeholder="show rows with \\u2026";field.setAttribute("aria-label","show rows with");
  table.parentNode.parentNode.insertBefore(field,table.parentNode);
  field.addEventListener("input",function(){var wanted=field.value.toLowerCase();
   Array.from(body.rows).forEach(function(row){row.hidden=row.textContent.toLowerCase().indexOf(wanted)<0;});});}
});
"""


def page(title: str, parts: list[str], style: str = STYLE, script: str = "") -> str:
    """The HTML of a page that asks no host for anything. title: in words; parts: HTML, in order."""
    body = "\n".join(parts)
    ending = f"\n<script>{script}</script>" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n{body}{ending}\n</body>\n</html>\n"
    )


def picture_url(picture: bytes) -> str:
    """A picture as a URL that holds it: JPEG by its first two bytes, else PNG."""
    kind = "jpeg" if picture[:2] == b"\xff\xd8" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
