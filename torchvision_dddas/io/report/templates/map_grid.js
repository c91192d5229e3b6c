// A pane under the tracks, which takes no clicks.
function groundPane(map){map.createPane("ground").style.zIndex=250;map.getPane("ground").style.pointerEvents="none";}
// Returns a function that draws the grid of local metres for the part of the map that is shown.
function metreGrid(map,grid,soft,words){return function(){
  const seen=map.getBounds(),more=seen.pad(.5),raw=(seen.getEast()-seen.getWest())/map.getSize().x*90;
  const power=10**Math.floor(Math.log10(raw)),step=[1,2,5,10].map(k=>k*power).find(s=>s>=raw);
  function line(value,ends,label,anchor,style){
   L.polyline(ends,{pane:"ground",color:soft,weight:1,opacity:.4,interactive:false}).addTo(grid);
   if(!seen.contains(label)||style&&value>seen.getNorth()-raw/4)return;
   const icon=L.divIcon({className:"tick "+style,html:words(String(+value.toFixed(6)).replace("-","\u2212")),iconSize:[60,16],iconAnchor:anchor});
   L.marker(label,{icon,interactive:false,keyboard:false,pane:"ground",zIndexOffset:9999}).addTo(grid);}
  grid.clearLayers();
  for(let e=Math.ceil(more.getWest()/step)*step;e<=more.getEast();e+=step)
   line(e,[[more.getSouth(),e],[more.getNorth(),e]],[seen.getNorth(),e],[-1,0],"");
  for(let n=Math.ceil(more.getSouth()/step)*step;n<=more.getNorth();n+=step)
   line(n,[[n,more.getWest()],[n,more.getEast()]],[n,seen.getEast()],[62,16],"right");};}
