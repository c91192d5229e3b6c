{# The script of the operator's page. #}
/*
{{ read_vendored("leaflet/LICENSE") }}
*/
{{ read_vendored("leaflet/leaflet.js") }}

{% include "map_grid.js" %}

(function(){
 "use strict";
 const get=id=>document.getElementById(id),picture=get("picture"),soft="#8a949e",area="#783c96",gaze="#e07b00";
 const dark=matchMedia("(prefers-color-scheme:dark)").matches;
 // Names come from files and streams: they become text nodes, never HTML.
 function make(kind,text,style){const e=document.createElement(kind);e.textContent=text;if(style)e.className=style;return e;}
 const words=(text,style)=>make("div",text,style);
 let session=null,retry=0;

 // The picture. A hidden page does not watch, so that nothing is encoded for it.
 function watch(){clearTimeout(retry);picture.src="picture.mjpg?"+Date.now();}
 picture.addEventListener("load",()=>{if(get("stale").textContent==="no picture yet")stale("");});
 picture.addEventListener("error",()=>{if(!document.hidden)retry=setTimeout(watch,3000);});
 document.addEventListener("visibilitychange",()=>{
  if(document.hidden){clearTimeout(retry);picture.removeAttribute("src");}else{watch();poll();}});
 function stale(text){get("stale").textContent=text;get("camera").classList.toggle("stale",!!text);}

 function showHealth(s){
  document.title=s.title;
  const trouble=get("trouble");
  if(trouble.textContent!==(s.trouble||"all is well"))trouble.textContent=s.trouble||"all is well";
  trouble.className=s.trouble?"bad":"good";
  get("now").textContent=s.now+" UTC"+(s.frame?" · frame "+s.frame:"");
  const tiles=document.querySelector("#health .tiles");
  tiles.replaceChildren(...s.figures.map(([name,value])=>{const e=make("div","");e.append(make("dt",name),make("dd",value));return e;}));
  if(s.idle_s>3&&s.frame)stale("no new result for "+Math.round(s.idle_s)+" s");
  else stale(picture.naturalWidth?"":"no picture yet");}

 let newest=0;
 function showEvents(s){
  get("events").replaceChildren(...s.events.map(([time,frame,text,isAlarm])=>{
   const e=make("li","",isAlarm?"is-alarm":"");
   e.append(make("span",time+(frame?" · frame "+frame:"")));if(isAlarm)e.append(make("span","alarm","badge"));
   e.append(text);return e;}));
  if(!s.events.length)get("events").append(make("li","nothing so far"));
  // The newest alarm stands at the top for half a minute by the clock of this page.
  const alarm=s.events.find(e=>e[3]);
  if(alarm&&alarm[4]>newest){
   newest=alarm[4];get("alarm").textContent=alarm[0]+" "+alarm[2];get("alarm").hidden=false;
   clearTimeout(showEvents.timer);showEvents.timer=setTimeout(()=>{get("alarm").hidden=true;},30000);}}

 function showTargets(s){
  const many=s.targets.length+s.more;
  get("count").textContent=many?String(many)+(s.more?", the first "+s.targets.length+" are listed":""):"none now";
  document.querySelector("#targets tbody").replaceChildren(...s.targets.map(t=>{
   const row=make("tr",""),name=make("th",""),chip=make("i",""),about=make("td",t.kind),error=make("td",t.error||"\u2013");
   name.scope="row";chip.style.background=t.colour;name.append(chip,t.id);about.append(make("small",t.place));
   if(t.error_m!==null)error.append(make("small",t.error_m.toFixed(1)+" m"));
   row.append(name,about,make("td",t.speed||"\u2013"),error);return row;}));}

 // The map in local metres, begun with the first place.
 const at=p=>[p[1],p[0]];
 function shade(hex){return dark?hex:"#"+hex.match(/\w\w/g).map(c=>Math.round(.72*parseInt(c,16)).toString(16).padStart(2,"0")).join("");}
 let map=null,isMoved=false,drawGrid,zoneLayer,moving,whole;
 function beginMap(){
  get("where").hidden=false;get("see").dataset.map="";
  map=L.map("map",{crs:L.CRS.Simple,minZoom:-10,maxZoom:9,zoomSnap:.25,attributionControl:false,zoomControl:false,
   preferCanvas:true,zoomAnimation:false,fadeAnimation:false,renderer:L.canvas({padding:.3})});
  groundPane(map);map.setView([0,0],0);
  drawGrid=metreGrid(map,L.layerGroup().addTo(map),soft,words);
  zoneLayer=L.featureGroup().addTo(map);moving=L.featureGroup().addTo(map);
  map.on("moveend resize",drawGrid);
  map.on("dragstart zoomstart",e=>{if(!map.fitting)isMoved=true;});
  map.on("mousemove click",e=>{get("place").textContent="east "+e.latlng.lng.toFixed(1)+" m, north "+e.latlng.lat.toFixed(1)+" m";});
  get("whole").addEventListener("click",()=>{isMoved=false;fit(true);});
  L.control.scale({imperial:false}).addTo(map);L.control.zoom({position:"bottomright"}).addTo(map);
  new ResizeObserver(()=>{map.invalidateSize();fit(true);}).observe(get("map"));
  fetch("zones.json").then(answer=>answer.json()).then(zones=>{
   for(const zone of zones){
    const ends=zone.rings.map(ring=>ring.map(at)),style={color:area,weight:zone.line?3:2,fillOpacity:.12,interactive:false};
    const drawn=(zone.line?L.polyline(ends,style):L.polygon(ends,style)).addTo(zoneLayer);
    // Names stand at the upper left, where they cover few targets.
    const corner=zone.line?ends[0][0]:drawn.getBounds().getNorthWest();
    L.tooltip({permanent:true,direction:"right",className:"tag",offset:[0,8]}).setLatLng(corner).setContent(words(zone.name,"zone")).addTo(map);}
   fit(true);});}
 // Follow the targets until the user moves the map.
 function fit(always){
  const box=L.latLngBounds([]);
  if(moving.getLayers().length)box.extend(moving.getBounds());
  // Zones far away do not make the targets too small to see.
  const near=box.isValid()?box.pad(2):null;
  zoneLayer.eachLayer(zone=>{if(!near||near.contains(zone.getBounds()))box.extend(zone.getBounds());});
  if(!box.isValid()||isMoved||!always&&map.getBounds().contains(box))return;
  map.fitting=true;map.fitBounds(box.pad(.15),{animate:false,maxZoom:4});map.fitting=false;drawGrid();}
 function showMap(m){
  if(!m)return;
  if(!map)beginMap();
  moving.clearLayers();
  const put=layer=>layer.addTo(moving),named=(layer,text,style)=>layer.bindTooltip(words(text,style),{permanent:true,direction:"right",className:"tag",offset:[6,0]});
  if(m.view.length)put(L.polygon(m.view.map(at),{color:gaze,weight:2,dashArray:"7 6",fill:false,interactive:false}));
  for(const [name,e,n] of m.landmarks)
   named(put(L.circleMarker([n,e],{radius:6,color:dark?"#0f1419":"#fff",weight:1.5,fillColor:"#1d7a4f",fillOpacity:1})),name,"landmark");
  if(m.camera)named(put(L.circleMarker(at(m.camera),{radius:6,color:soft,weight:2,fillOpacity:.2})),"camera");
  for(const t of m.targets){
   const end=at(t.way[t.way.length-1]),faint=t.lost?.3:1,color=shade(t.colour);
   put(L.polyline(t.way.map(at),{color,weight:2,opacity:.7*faint,interactive:false}));
   if(t.ring.length)put(L.polygon(t.ring.map(at),{color,weight:1,fillOpacity:.12,interactive:false}));
   const dot=put(L.circleMarker(end,{radius:5,color:dark?"#0f1419":"#fff",weight:1.5,fillColor:color,fillOpacity:faint}));
   if(!t.lost)named(dot,t.id,"target");}
  if(m.cause)get("place").textContent="not located: "+m.cause;
  fit(false);}

 let timer=0;
 async function poll(){
  clearTimeout(timer);
  try{
   const answer=await fetch("state.json",{cache:"no-store",signal:AbortSignal.timeout(5000)});
   if(answer.status===401)return location.reload();
   const s=await answer.json();
   // A new run on this port: its targets and zones are others.
   if(session!==null&&s.session!==session)return location.reload();
   session=s.session;
   showHealth(s);showEvents(s);showTargets(s);showMap(s.map);
   if(poll.lost){poll.lost=false;watch();}
  }catch(error){
   if(!(error instanceof TypeError||error instanceof DOMException))console.error(error);
   poll.lost=true;stale("no connection to the run");
   get("trouble").textContent="no connection to the run";get("trouble").className="bad";}
  timer=setTimeout(poll,document.hidden?10000:1000);}
 poll();
})();
