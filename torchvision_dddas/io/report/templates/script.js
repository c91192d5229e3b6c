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
  field.placeholder="show rows with \u2026";field.setAttribute("aria-label","show rows with");
  table.parentNode.parentNode.insertBefore(field,table.parentNode);
  field.addEventListener("input",function(){var wanted=field.value.toLowerCase();
   Array.from(body.rows).forEach(function(row){row.hidden=row.textContent.toLowerCase().indexOf(wanted)<0;});});}
});
