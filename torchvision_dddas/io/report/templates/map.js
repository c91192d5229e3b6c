(function(){
 const data=JSON.parse(document.getElementById("map-data").textContent),get=id=>document.getElementById(id);
 const dark=matchMedia("(prefers-color-scheme:dark)").matches,soft="#8a949e",area="#783c96",gaze="#e07b00";
 const map=L.map("map",{crs:L.CRS.Simple,minZoom:-10,maxZoom:9,zoomSnap:.25,attributionControl:false,zoomControl:false,preferCanvas:true,
  renderer:L.canvas({tolerance:8,padding:.3})});
 const at=p=>[p[1],p[0]],spot=row=>[row[2],row[1]],box=b=>[[b[1],b[0]],[b[3],b[2]]];
 // Names come from files, so they become text nodes, never HTML.
 function words(text,style){const e=document.createElement("div");e.textContent=text;e.className=style||"";return e;}
 const tag=(layer,text,stays)=>layer.bindTooltip(words(text),{permanent:stays,direction:"right",className:"tag",offset:[6,0]});
 function place(e,n){
  let text=e.toFixed(1)+" m east, "+n.toFixed(1)+" m north";
  if(data.degrees){const [w,s,x,y]=data.box,u=(e-w)/(x-w),v=(n-s)/(y-s),d=data.degrees;
   const mix=k=>(1-v)*((1-u)*d[0][k]+u*d[1][k])+v*((1-u)*d[2][k]+u*d[3][k]);
   text+="\nlatitude "+mix(1).toFixed(6)+", longitude "+((mix(0)+540)%360-180).toFixed(6);}
  return text;}
 function shade(hex){return dark?hex:"#"+hex.match(/\w\w/g).map(c=>Math.round(.72*parseInt(c,16)).toString(16).padStart(2,"0")).join("");}
 const unit=data.unit==="s"?t=>t.toFixed(1)+" s":t=>"frame "+Math.round(t);
 function when(t){return unit(t)+(data.utc===null?"":", "+new Date((data.utc+t)*1000).toISOString().slice(11,19)+" UTC");}
 const groups={};
 function group(name,colour){
  if(groups[name])return groups[name];
  const layer=groups[name]=L.layerGroup().addTo(map),label=document.createElement("label"),tick=document.createElement("input");
  tick.type="checkbox";tick.checked=true;tick.style.accentColor=colour;label.append(tick," "+name);get("layers").append(label);
  tick.addEventListener("change",()=>tick.checked?layer.addTo(map):layer.remove());
  return layer;}
 groundPane(map);
 map.fitBounds(box(data.box));
 const lines=data.movers.map(m=>({name:m.name,kind:m.kind,colour:m.kind==="camera"?soft:shade(m.colour),parts:m.parts,
  places:m.parts.map(part=>part.map(spot))}));

 // Draw the photo and a grid below the tracks. The lines of the grid follow the map.
 if(data.photo)L.imageOverlay(data.photo.url,box(data.photo.box),{pane:"ground",opacity:dark?.6:.8,alt:"photo of the ground"})
  .addTo(group("photo",soft));
 const drawGrid=metreGrid(map,group("grid, m",soft),soft,words);
 map.on("moveend resize",drawGrid);

 // Draw zones, looks of ground vehicles, and events.
 const named=[];
 for(const [name,rings,isLine] of data.zones){
  const ends=rings.map(ring=>ring.map(at)),style={color:area,weight:isLine?3:2,fillOpacity:.12,interactive:false};
  named.push(tag((isLine?L.polyline(ends,style):L.polygon(ends,style)).addTo(group("zones",area)),name,true));}
 // Move a zone's name below another name that it would cover.
 function part(){
  const kept=[];
  for(const zone of named){
   const e=zone.getTooltip().getElement();if(!e||!e.isConnected)continue;
   e.style.marginTop="0px";
   for(let k=0,r;k<kept.length;k++){
    r=e.getBoundingClientRect();const o=kept[k];
    if(r.left<o.right&&o.left<r.right&&r.top<o.bottom-1&&o.top<r.bottom-1){
     e.style.marginTop=parseFloat(e.style.marginTop)+o.bottom-r.top+"px";k=-1;}}
   kept.push(e.getBoundingClientRect());}}
 map.on("zoomend resize layeradd",part);
 for(const look of data.looks)
  L.polyline(look.map(at),{color:"#286e96",weight:1,opacity:.35,interactive:false}).addTo(group("looks of ground vehicles","#286e96"));
 for(const [letter,text,colour,p] of data.signs){
  const face=words(letter,"sign");face.style.background=colour;
  tag(L.marker(at(p),{icon:L.divIcon({className:"",html:face,iconSize:[16,16]}),keyboard:false}).addTo(group("events",colour)),text);}

 // Draw the movers. A row: time, east, north, semi-axes and bearing of the ellipse, frame.
 function ellipse(row){
  const s=Math.sin(row[5]*Math.PI/180),c=Math.cos(row[5]*Math.PI/180);
  return Array.from({length:48},(_,k)=>{const u=row[3]*Math.cos(k*Math.PI/24),v=row[4]*Math.sin(k*Math.PI/24);
   return[row[2]+u*c+v*s,row[1]+u*s-v*c];});}
 const view=L.polygon([],{color:gaze,weight:2,dashArray:"7 6",fill:false,interactive:false});
 if(data.views.length)view.addTo(group("view of the camera",gaze));
 const chosen=L.polygon([],{weight:2,interactive:false}).addTo(map);
 const title={target:"targets",landmark:"landmarks",camera:"camera",fused:"fused targets"},few=lines.length<=60;
 for(const m of lines){
  m.group=group(title[m.kind],m.kind==="target"?"#5a6570":m.colour);
  m.whole=L.polyline(m.places,{color:m.colour,weight:2,opacity:.35}).addTo(m.group);
  m.past=L.polyline([],{color:m.colour,weight:m.kind==="target"?3:1.5,interactive:false}).addTo(m.group);
  m.dot=L.circleMarker([0,0],{radius:m.kind==="target"?5:7,color:dark?"#0f1419":"#fff",weight:1.5,fillColor:m.colour,fillOpacity:1});
  tag(m.dot,m.name,few);
  if(m.kind==="target"||m.kind==="fused")m.ring=L.polygon([],{color:m.colour,weight:1,fillOpacity:.1,interactive:false}).addTo(group("95 % ellipses","#5a6570"));
  for(const layer of [m.whole,m.dot])layer.on("click",event=>choose(m,event.latlng));}
 function choose(m,where){
  let row=null,least=Infinity;
  for(const part of m.parts)for(const one of part){
   const far=Math.hypot(one[1]-where.lng,one[2]-where.lat);if(far<least){least=far;row=one;}}
  const known=row[3]!==null,size=known?"\n95 % ellipse: semi-axes "+row[3].toFixed(2)+" m and "+row[4].toFixed(2)+" m":"";
  L.popup().setLatLng(spot(row)).setContent(words((m.kind==="target"?"target ":"")+m.name+
   "\n"+when(row[0])+(data.unit==="s"?", frame "+row[6]:"")+"\n"+place(row[1],row[2])+size)).openOn(map);
  chosen.setStyle({color:m.colour}).setLatLngs(known?ellipse(row):[]);}
 map.on("popupclose",()=>chosen.setLatLngs([]));

 const [first,last]=data.span,steps=data.steps,half=.51*(last-first)/Math.max(steps-1,1),slider=get("time");
 function show(t){
  for(const m of lines){
   const past=[];let now=null,isSeen=false;
   m.parts.forEach((part,i)=>{
    if(part[0][0]>t)return;
    let k=part.length;while(part[--k][0]>t);
    const a=part[k],b=part[k+1],share=b?(t-a[0])/(b[0]-a[0]):0;
    const here=b?a.map((v,j)=>j<3?v+share*(b[j]-v):v):a;
    past.push(m.places[i].slice(0,k+1).concat([spot(here)]));
    now=here;isSeen=!!b||t-a[0]<=half;});
   m.past.setLatLngs(past);
   // The dot of a target that is not seen now stays pale at its last place, unless there are many targets.
   if(!isSeen&&!few)now=null;
   if(now)m.group.addLayer(m.dot.setLatLng(spot(now)).setStyle({fillOpacity:isSeen?1:.3}));else m.group.removeLayer(m.dot);
   if(m.ring)m.ring.setLatLngs(now&&now[3]!==null?ellipse(now):[]);}
  let seen=null;for(const one of data.views)if(one[0]<=t+half)seen=one;
  view.setLatLngs(seen?seen[1].map(at):[]);
  get("now").textContent=when(t);}
 const time=()=>first+slider.value*(last-first)/Math.max(steps-1,1);
 slider.max=steps-1;slider.value=steps-1;
 slider.addEventListener("input",()=>{stop();show(time());});
 let timer=0,exact=0;
 function stop(){clearInterval(timer);timer=0;get("play").textContent="Play";}
 get("play").addEventListener("click",()=>{
  if(timer)return stop();
  // Play as fast as the clip, or faster, so that playing takes a minute at most.
  const whole=data.unit==="s"?Math.min(last-first,60):20,step=.05*(steps-1)/Math.max(whole,.05);
  exact=+slider.value>=steps-1?0:+slider.value;get("play").textContent="Pause";
  timer=setInterval(()=>{exact+=step;slider.value=exact;show(time());if(exact>=steps-1)stop();},50);});
 if(steps<2)slider.parentNode.hidden=true;
 map.on("mousemove click",event=>{get("place").textContent=place(event.latlng.lng,event.latlng.lat).replace("\n", ", ");});
 L.control.scale({imperial:false}).addTo(map);
 get("whole").addEventListener("click",()=>map.fitBounds(box(data.whole)));
 L.control.zoom({position:"bottomright"}).addTo(map);  // at the bottom, where popups rarely open
 drawGrid();show(last);part();
})();
